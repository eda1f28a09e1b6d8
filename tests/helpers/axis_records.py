"""Records of an axis whose numbers are known."""

import numpy as np
import pandas as pd

# Newtons per volt.
GAIN = 12.0
TRUTH = {"m": 5.0, "offset": 0.7, "dry.Fc": 3.0, "viscous.Fv": 8.0}


def slide(t: np.ndarray, u: np.ndarray, v: float, m: float, Fc: float, Fv: float, offset: float) -> np.ndarray:
    """Positions of `m v' = u - offset - Fc sign(v) - Fv v`, with u held from sample to sample: closed forms, piece by
    piece from one change between stick and slip to the next.
    """
    q = np.zeros(t.size)
    for k, (dt, load) in enumerate(zip(np.diff(t), u[:-1] - offset, strict=True)):
        q[k + 1] = q[k]
        while dt > 0 and (v != 0 or abs(load) > Fc):
            sign = np.sign(v) or np.sign(load)
            steady = (load - sign * Fc) / Fv
            turns = steady * sign < 0 and v != 0
            stop = np.log1p(-v / steady) * m / Fv if turns else np.inf
            tau = min(dt, stop)
            decayed = -np.expm1(-tau * Fv / m)
            q[k + 1] += steady * tau + (v - steady) * decayed * m / Fv
            v = 0.0 if stop <= dt else v + (steady - v) * decayed
            dt -= tau
    return q


def axis_frame(seed: int = 0, v: float = 0.0) -> pd.DataFrame:
    """A record of an axis with the numbers of TRUTH that starts at the velocity `v`.

    There is no force over the first 20 samples, the parabola through which is to show the velocity.
    """
    t = 10.0 + np.arange(0.0, 2.0, 2.5e-3)
    u = np.where(t > 10.05, 0.8 * np.sign(np.sin(5.1 * t + seed)) + 1.5 * np.sin(9.3 * t), 0.0)
    q = slide(t, GAIN * u, v, *(TRUTH[name] for name in ("m", "dry.Fc", "viscous.Fv", "offset")))
    noise = 1e-6 * np.random.default_rng(seed).standard_normal(t.size)
    return pd.DataFrame({"time": t, "pos": q + noise, "volt": u})
