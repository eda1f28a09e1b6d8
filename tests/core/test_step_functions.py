"""Which functions of time and parameters are taken for step functions."""

import logging

import jax
import jax.numpy as jnp
import pytest

import jaxmodsim as jms
from jaxmodsim._core import trace_checks
from jaxmodsim._core.trace_checks import traced

PARAMS = {"ts": 1.0, "F": 2.0, "grid": jnp.arange(3.0)}


@pytest.fixture
def remarks(caplog):
    trace_checks._warn.cache_clear()
    caplog.set_level(logging.WARNING, logger="jaxmodsim")
    return caplog


def look(fn):
    traced(fn, name="fn of a test", t=jnp.ones(()), q=jnp.ones(1), qd=jnp.ones(1), params=PARAMS)


STEPS = {
    "where": lambda t, q, qd, p: jnp.where(t > p["ts"], p["F"], 0.0),
    "product": lambda t, q, qd, p: (t >= p["ts"]) * p["F"],
    "cond": lambda t, q, qd, p: jax.lax.cond(t - p["ts"] > 0.0, lambda: p["F"], lambda: 0.0),
    "heaviside": lambda t, q, qd, p: jnp.heaviside(t - p["ts"], 0.5),
    "square_wave": lambda t, q, qd, p: jnp.sign(jnp.sin(p["ts"] * t)),
    "floor": lambda t, q, qd, p: jnp.floor(t / p["ts"]),
    "sawtooth": lambda t, q, qd, p: jnp.mod(t, p["ts"]),
    "in_jit": jax.jit(lambda t, q, qd, p: jnp.where(t > p["ts"], p["F"], 0.0)),
}
SMOOTH = {
    "sine": lambda t, q, qd, p: p["F"] * jnp.sin(p["ts"] * t),
    "clip": lambda t, q, qd, p: jnp.clip(t / p["ts"], 0.0, 1.0),
    "interp": lambda t, q, qd, p: jnp.interp(t, p["grid"], p["grid"]),
    "absolute": lambda t, q, qd, p: jnp.abs(t - p["ts"]),
    "maximum": lambda t, q, qd, p: jnp.maximum(t, p["ts"]),
    "constant_time": lambda t, q, qd, p: jnp.where(t > 1.0, p["F"], 0.0),
    "of_state": lambda t, q, qd, p: jnp.where(qd[0] > p["ts"], p["F"], 0.0),
    "of_params": lambda t, q, qd, p: jnp.where(p["F"] > p["ts"], p["F"], 0.0) * t,
}


@pytest.mark.parametrize("kind", STEPS)
def test_a_step_at_a_time_in_params_is_named(remarks, kind):
    look(STEPS[kind])
    look(STEPS[kind])
    (record,) = remarks.records
    assert "params['ts']" in record.getMessage()
    assert "jaxmodsim.Switch" in record.getMessage()


@pytest.mark.parametrize("kind", SMOOTH)
def test_other_functions_are_not(remarks, kind):
    look(SMOOTH[kind])
    assert not remarks.records


def test_a_run_says_so_once(remarks):
    scene = jms.Scene(
        lambda t, q, qd, p: 0.5 * qd[0] ** 2,
        params={"ts": 1.0},
        effects=(jms.AppliedForce(lambda t, q, qd, p: jnp.where(t > p["ts"], 1.0, 0.0) * jnp.ones(1), name="push"),),
    )
    jms.simulate(scene, [0.0], [0.0], 2.0)
    said = [x.getMessage() for x in remarks.records if "Switch" in x.getMessage()]
    assert len(said) == 1
    assert "In fn of AppliedForce 'push' a comparison" in said[0]
