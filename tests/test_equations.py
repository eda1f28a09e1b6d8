"""How many equations XLA receives of each scene: a budget, since the time of first calls grows with them."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
import typer

from bench import census

MOST, LEAST = 1.05, 0.95  # of the record
RECORDED = [(name, way, count) for name, ways in census.recorded().items() for way, count in ways.items()]


def check_budget(name: str, way: str, count: int, recorded: int) -> None:
    said = f"{name}, {way}: {count} equations, but {recorded} in tests/equations.json."
    record = f'python -m bench.census "{name}" --record'
    sources = f'python -m bench.census "{name}" --of {way}'
    assert count <= MOST * recorded, (
        f"{said} First calls take longer. To see where equations come from: {sources}. To accept them: {record}."
        f" The record holds for {json.loads(census.RECORD.read_text())['versions']}."
    )
    assert count >= LEAST * recorded, f"{said} To hold what was gained, lower the record: {record}."


@pytest.mark.parametrize(("name", "way", "recorded"), RECORDED, ids=[f"{name}, {way}" for name, way, _ in RECORDED])
def test_scenes_have_the_equations_of_the_record(name: str, way: Any, recorded: int) -> None:
    check_budget(name, way, len(census.traced(name, way)), recorded)


def test_more_and_fewer_equations_are_told_with_the_remedy() -> None:
    check_budget("a box", "run", 105, 100)
    check_budget("a box", "run", 95, 100)
    with pytest.raises(AssertionError, match=r"a box, run: 106 equations, but 100 .* --of run\. .* --record\. .*jax"):
        check_budget("a box", "run", 106, 100)
    with pytest.raises(AssertionError, match=r'lower the record: python -m bench.census "a box" --record'):
        check_budget("a box", "run", 94, 100)


def test_equations_count_as_often_as_xla_receives_them() -> None:
    square = jax.jit(lambda x: x * x)

    def function(x: Any) -> Any:
        x = jax.lax.fori_loop(0, 9, lambda i, x: jnp.sin(x), square(square(x)))
        return jax.lax.cond(x > 0.0, jnp.cos, lambda x: square(x) / 2.0, x)

    found = Counter(eqn.primitive.name for eqn, *_ in census.equations(jax.make_jaxpr(function)(1.0).jaxpr))
    # Three calls of one function, a loop (which JAX writes as a scan) with one sine, and both branches.
    assert {name: found[name] for name in ("jit", "mul", "scan", "sin", "cond", "cos", "div")} == {
        "jit": 3, "mul": 1, "scan": 1, "sin": 1, "cond": 1, "cos": 1, "div": 1
    }  # fmt: skip


def test_equations_are_listed_and_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(census, "RECORD", tmp_path / "equations.json")
    monkeypatch.setattr(census, "LINES", 1000)
    census.RECORD.write_text('{"scenes": {"LuGre box": {"run": 1}}}')
    census.main(record=True)
    count = census.recorded()["LuGre box"]["run"]
    assert capsys.readouterr().out == f"LuGre box: {{'run': {count}}}\n"
    census.main(["LuGre box"])
    title, _, *lines = capsys.readouterr().out.splitlines()
    assert title == f"LuGre box, run: {count} equations"
    rows = [(name.strip(), int(inner), int(own)) for inner, own, name in (line.split(maxsplit=2) for line in lines)]
    assert sum(own for _, _, own in rows) == count
    inner = {name: inner for name, inner, _ in rows}
    assert count > inner["simulation/_solve.py:solve"] > inner["scene/_dynamics.py:forward_dynamics"] > 0
    with pytest.raises(
        typer.BadParameter, match="no scene is called 'a box'; there are: two viscous joints, LuGre box"
    ):
        census.main(["a box"])
