"""The page that simulates: `python docs/live/build.py live.html` writes it, one file that needs no network."""

import argparse
import json
import subprocess
import sys
import tempfile
from base64 import b64encode
from pathlib import Path

import jax
import jax.tree_util as jtu

import jaxmodsim as jms
from jaxmodsim.problems import belt_oscillator, ramped_box
from jaxmodsim.scene import elements

HERE = Path(__file__).parent
# Speed below which friction sticks [m/s]: what holds creeps with less than that.
WIDTH = 1e-6


def exact_scenes() -> dict[str, jms.Scene]:
    """The scenes of the page by their names in its script, with exact stick."""
    belt = belt_oscillator.STRIBECK
    curve = {"Fc": belt["Fc"], "Fs": belt["Fs"], "vs": belt["vs"]}
    bristle = jms.LuGre(sigma0=1e5, sigma1=60.0, sigma2=belt["Fv"], **curve)
    return {
        "beltLugre": belt_oscillator.scene(bristle),
        "beltCoulomb": belt_oscillator.scene(jms.Stribeck(**belt)),
        "boxLugre": ramped_box.scene(ramped_box.lugre(sigma1=12.0)),
        "boxCoulomb": ramped_box.scene(ramped_box.stribeck()),
    }


def scenes() -> dict[str, jms.Scene]:
    """The scenes that the page runs: set-valued laws are regularized."""
    return exact_scenes() | {
        "beltCoulomb": belt_oscillator.scene(jms.Regularized(belt_oscillator.stribeck(), WIDTH)),
        "boxCoulomb": ramped_box.scene(jms.Regularized(ramped_box.stribeck(), WIDTH)),
    }


def program(made: dict[str, jms.Scene]) -> bytes:
    """The scenes' C code as WebAssembly, compiled by `ziglang`."""
    code = [jms.to_c(scene, name=name) for name, scene in made.items()]
    calls = "\n".join(f"SCENE({name})" for name in made)
    names = ["results", *(f"{name}_{call}" for name in made for call in ("arguments", "simulate"))]
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "page.c", Path(folder) / "page.wasm"
        source.write_text("\n".join([*code, (HERE / "run.c").read_text(), calls]))
        compiler = [sys.executable, "-m", "ziglang", "cc", "--target=wasm32-wasi", "-mexec-model=reactor"]
        exports = [f"-Wl,--export={name}" for name in names]
        subprocess.run([*compiler, "-O2", "-s", *exports, "-o", str(out), str(source)], check=True)
        return out.read_bytes()


def build(out: Path) -> Path:
    """Write the page to the file `out`."""
    with jax.enable_x64(True):
        made = scenes()
        code = b64encode(program(made)).decode()
        numbers = {
            name: {"names": [*elements(scene)], "numbers": [float(x) for x in jtu.tree_leaves(scene)]}
            for name, scene in made.items()
        }
    page = (HERE / "page.html").read_text()
    page = page.replace("/* SCENES */", f"const SCENES = {json.dumps(numbers)};\nconst PROGRAM = {json.dumps(code)};")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", default=Path("live.html"))
    build(parser.parse_args().out)
