"""The page that simulates: `python docs/live/build.py live.html` writes it, one file that needs no network."""

import argparse
from pathlib import Path

import jax

import jaxmodsim as jms
from jaxmodsim.problems import belt_oscillator, ramped_box

# Speed below which friction sticks [m/s]: what holds creeps with less than that.
WIDTH = 1e-6


def scenes() -> dict[str, jms.Scene]:
    """The scenes of the page by their names in its script."""
    belt = belt_oscillator.STRIBECK
    curve = {"Fc": belt["Fc"], "Fs": belt["Fs"], "vs": belt["vs"]}
    bristle = jms.LuGre(sigma0=1e5, sigma1=60.0, sigma2=belt["Fv"], **curve)
    return {
        "beltLugre": belt_oscillator.scene(bristle),
        "beltCoulomb": belt_oscillator.scene(jms.Regularized(jms.Stribeck(**belt), WIDTH)),
        "boxLugre": ramped_box.scene(ramped_box.lugre(sigma1=12.0)),
        "boxCoulomb": ramped_box.scene(jms.Regularized(ramped_box.stribeck(), WIDTH)),
    }


def build(out: Path) -> Path:
    """Write the page to the file `out`."""
    with jax.enable_x64(True):
        script = "\n".join(jms.to_javascript(scene, name=name) for name, scene in scenes().items())
    page = Path(__file__).with_name("page.html").read_text().replace("/* SCENES */", script)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", default=Path("live.html"))
    build(parser.parse_args().out)
