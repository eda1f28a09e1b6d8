"""Seven-joint arm: friction of all joints, their rotors and a load in the hand, from torques and angles.

The arm is read from MJCF text. Synthetic records (sums of sines, noise on torques and encoders) are compared by the
balance of torques: the model's inverse dynamics under filtered angles, both sides through the same low-pass filter. So
one linear problem in 25 numbers, solved again where it is not linear, holds all joints with their coupling, and nothing
is simulated. Repeated with new noise, it shows how often the 95 % intervals hold the truth.

Run it: `python examples/g6_seven_joint_arm.py [--smoke] [--out DIR]`.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.signal import butter, filtfilt

import jaxmodsim as jms
from jaxmodsim.mechanics import inverse_dynamics
from jaxmodsim.scene import read_robot, replace_numbers

RATE, CUTOFF, EDGE = 400.0, 20.0, 200  # [Hz], [Hz], samples that the filter spoils at either end
ANGLE_NOISE, TORQUE_NOISE = 5e-6, 0.01  # [rad], share of each joint's torque
LENGTHS, MASSES = (0.2, 0.3, 0.1, 0.25, 0.1, 0.1, 0.12), (5.0, 4.0, 3.0, 2.5, 1.5, 1.0, 1.2)
FC, FV = np.array([6.0, 8.0, 4.0, 4.0, 1.5, 1.2, 0.8]), np.array([9.0, 10.0, 5.0, 4.0, 1.0, 0.8, 0.5])
ROTORS = np.array([0.6, 0.6, 0.4, 0.3, 0.1, 0.08, 0.05])
LOAD = np.array([1.2, 0.02, -0.01, 0.06])  # mass [kg] and centre [m] of the last link


def arm() -> jms.Scene:
    """Seven hinges, turn by turn about z and y, with Coulomb and viscous friction in each."""
    text = ""
    for i, (length, mass) in enumerate(zip(LENGTHS, MASSES, strict=True)):
        inertia = mass * length**2 / 12 + 1e-3
        text += f'<body name="link{i}" pos="0 0 {LENGTHS[i - 1] if i else 0}"><joint name="joint{i}"'
        text += f' armature="{ROTORS[i]}" axis="{"0 1 0" if i % 2 else "0 0 1"}"/>'
        text += f'<inertial mass="{mass}" pos="0.02 -0.01 {length / 2}"'
        text += f' diaginertia="{inertia} {inertia} 1e-3"/>'
    robot = read_robot(f"<mujoco><worldbody>{text}{'</body>' * 7}</worldbody></mujoco>")
    effects = []
    for i in range(7):
        along = lambda q, i=i: q[i]  # noqa: E731
        effects.append(jms.Friction(jms.Regularized(jms.Coulomb(FC[i]), 5e-3), along=along, name=f"dry{i}"))
        effects.append(jms.Friction(jms.Viscous(FV[i]), along=along, name=f"wet{i}"))
    return jms.Scene(robot.lagrangian, robot.params, tuple(effects), coordinates=robot.coordinates)


def torques(scene: jms.Scene, numbers: jax.Array, q: jax.Array, qd: jax.Array, qdd: jax.Array) -> jax.Array:
    """Torques of the drives [N m] along a motion, of shape [samples, 7] each; Fc, Fv, rotors and load are free."""
    values = {f"dry{i}.Fc": numbers[i] for i in range(7)} | {f"wet{i}.Fv": numbers[7 + i] for i in range(7)}
    values |= {"armature": numbers[14:21], "link6.mass": numbers[21], "link6.center": numbers[22:]}
    scene, t = replace_numbers(scene, values), jnp.zeros(())

    def at(q: jax.Array, qd: jax.Array, qdd: jax.Array) -> jax.Array:
        friction = sum(each.act(t, q, qd, None, scene.params).generalised for each in scene.effects)
        return inverse_dynamics(scene.lagrangian, t, q, qd, qdd, scene.params) - friction

    return jax.vmap(at)(q, qd, qdd)


def low_pass(x: np.ndarray) -> np.ndarray:
    """Without delay, over time, the first axis."""
    return filtfilt(*butter(4, CUTOFF, fs=RATE), x, axis=0)


def main(out: Path, smoke: bool = False) -> None:
    """Make records, identify, count."""
    sets, seconds = (2, 6.0) if smoke else (20, 10.0)
    t, rng, scene = np.arange(0.0, seconds, 1 / RATE), np.random.default_rng(0), arm()
    drawn = [(rng.uniform(0.05, 0.25), rng.uniform(0.6, 5.0), rng.uniform(0, 6.28)) for _ in range(35)]
    a, w, phase = (np.reshape(x, (7, 5, 1)) for x in zip(*drawn, strict=True))
    q, qd, qdd = (np.sum(a * w**k * np.sin(w * t + phase + k * np.pi / 2), axis=1).T for k in range(3))
    model = jax.jit(lambda x, *motion: torques(scene, x, *motion))
    slopes = jax.jit(lambda x, *motion: jax.jacfwd(lambda x: torques(scene, x, *motion))(x))
    truth = np.concatenate([FC, FV, ROTORS, LOAD])
    exact = np.asarray(model(truth, q, qd, qdd))
    size, keep = np.std(exact, axis=0), slice(EDGE, -EDGE, int(RATE / CUTOFF / 2))
    held, values, errors = [], truth, truth
    for _ in range(sets):
        measured = exact + TORQUE_NOISE * size * rng.standard_normal(q.shape)
        angle = low_pass(q + ANGLE_NOISE * rng.standard_normal(q.shape))
        speed = np.gradient(angle, 1 / RATE, axis=0)
        motion = angle, speed, np.gradient(speed, 1 / RATE, axis=0)
        values = 1.4 * truth
        for _ in range(4):
            left = low_pass(measured - np.asarray(model(values, *motion)))[keep]
            columns = low_pass(np.asarray(slopes(values, *motion)))[keep]
            level = np.std(left, axis=0)
            matrix = np.reshape(columns / level[:, None], (-1, truth.size))
            values = values + np.linalg.lstsq(matrix, np.reshape(left / level, -1))[0]
        errors = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)))
        held.append(np.abs(values - truth) < 1.96 * errors)
    shares = np.mean(held, axis=0)
    names = [f"{kind}{i}" for kind in ("Fc", "Fv", "rotor") for i in range(7)] + ["mass", "x", "y", "z"]
    for row in zip(names, truth, values, errors, shares, strict=True):
        print("{:8} true {:8.4f}  estimate {:8.4f} +- {:.4f}  held in {:4.0%}".format(*row))
    print(f"{sets} records: intervals of friction held in {np.mean(shares[:14]):.1%}, all in {np.mean(shares):.1%}")
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.errorbar(names, 100 * (values / truth - 1), 196 * errors / np.abs(truth), fmt=".", color="#0072b2", capsize=2)
    left.set(ylabel="estimate less truth, 95 % interval [%]", title="the last record")
    right.bar(names, 100 * shares, color="#009e73")
    right.axhline(95.0, color="#d55e00", lw=1)
    right.set(ylabel=f"intervals that hold, of {sets} records [%]", title="coverage")
    for axis in (left, right):
        axis.tick_params(axis="x", rotation=90, labelsize=7)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "g6_seven_joint_arm.png", dpi=110)
    print(f"wrote {out / 'g6_seven_joint_arm.png'}")


if __name__ == "__main__":
    jms.tune_cpu()
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="small and quick")
    parser.add_argument("--out", type=Path, default=Path("example-output"))
    main(**vars(parser.parse_args()))
