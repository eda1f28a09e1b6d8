"""Records of an axis whose numbers are known."""

import numpy as np
import pandas as pd

# Newtons per volt.
GAIN = 12.0
TRUTH = {"m": 5.0, "offset": 0.7, "dry.Fc": 3.0, "viscous.Fv": 8.0}


def axis_frame(seed: int = 0, v: float = 0.0) -> pd.DataFrame:
    """A record of an axis with the numbers of TRUTH, from a plain Euler simulation that starts at the velocity `v`.

    There is no force over the first 20 samples, the parabola through which is to show the velocity.
    """
    t = 10.0 + np.arange(0.0, 2.0, 2.5e-3)
    u = np.where(t > 10.05, 0.8 * np.sign(np.sin(5.1 * t + seed)) + 1.5 * np.sin(9.3 * t), 0.0)
    q = np.zeros_like(t)
    for k in range(1, t.size):
        for _ in range(25):
            v += 1e-4 * (GAIN * u[k - 1] - 0.7 - 3.0 * np.tanh(v / 1e-3) - 8.0 * v) / 5.0
            q[k] += 1e-4 * v
        q[k] += q[k - 1]
    noise = 1e-6 * np.random.default_rng(seed).standard_normal(t.size)
    return pd.DataFrame({"time": t, "pos": q + noise, "volt": u})
