"""The sentences of `check_gradients`."""

import math

from ._differences import Agreement, DerivativeEstimate, Grazing, History, Sample, changed, first_difference

# Part of the largest derivative, per relative change of a number, below which others count as zero.
_TINY = 1e-3
_MODES = {0: "stick", 1: "forward slip", -1: "backward slip"}


def end(name: str, center: Sample, beside: Sample) -> str:
    """What becomes different at the evaluation `beside`."""
    place = f"{name}: at {beside.x:.7g}, {_percent(beside.x - center.x, center.x)} from here,"
    if beside.trouble:
        return f"{place} the run fails: {beside.trouble}"
    key = changed(center.histories, beside.histories)
    assert key is not None
    here, there = (sample.histories.get(key) for sample in (center, beside))
    k = first_difference(here, there) if here and there else 0
    text = f"{place} the sequence of modes is another: change {k + 1} of {key[1]!r}{_run(key[0])}"
    old, new = _change(here, k), _change(there, k)
    if new is None:
        return f"{text}, {old} here, does not happen there."
    if old is None:
        return f"{text}, {new}, happens there only."
    return f"{text} is {new} in place of {old}."


def modes_change(name: str) -> str:
    """What it means that the modes change right beside the number."""
    return (
        f"{name}: not differentiable here, as far as steps can tell: the modes change right beside this value, and a"
        " gradient holds on one side at most. Move away from it before you use one."
    )


def no_differences(name: str) -> str:
    """What to do if there is nothing to compare with."""
    return (
        f"{name}: too few runs beside this value succeed to compare with; pass smaller steps by"
        f" scales={{{name!r}: ...}}."
    )


def one_sided(name: str, guess: DerivativeEstimate) -> str:
    """Where the differences are from."""
    return f"{name}: the differences are from {guess.sides} only."


def kink(name: str, slopes: tuple[float, float]) -> str:
    """What a kink means."""
    return (
        f"{name}: not differentiable here: the slope is {slopes[0]:.7g} from below and {slopes[1]:.7g} from above,"
        " while the modes stay the same. Look for abs, maximum, sign or where at their corner; move away from it."
    )


def grazing(name: str, x: float, near: Grazing) -> str:
    """What near grazing means."""
    return (
        f"{name}: grazing suspected: the event of {near.effect!r} at t = {near.t:.6g}{_run(near.run)} goes as a square"
        f" root that ends near {name} = {near.vanishes:.6g}, {_percent(near.vanishes - x, x)} from here, where"
        " derivatives are infinite. A gradient means little beyond a small part of that distance."
    )


def unclear(name: str, guess: DerivativeEstimate) -> str:
    """What to do if the differences are too noisy."""
    return (
        f"{name}: the differences are uncertain by {guess.error:.1g} and tell nothing. Tighten rtol and atol of"
        f" simulate, or pass other steps by scales={{{name!r}: ...}}."
    )


def parting(
    name: str, forward: float, reverse: float, guess: DerivativeEstimate, limits: Agreement, scale: float
) -> tuple[str, ...]:
    """Where the three derivatives differ, and by how much; empty if they agree."""
    derivatives = {"forward mode": forward, "reverse mode": reverse}
    bad = [mode for mode, value in derivatives.items() if not math.isfinite(value)]
    if bad:
        return (
            f"{name}: {' and '.join(bad)} gives no finite derivative, the differences {guess.value:.7g}. Look for a"
            " square root, norm or power at zero, and for where() around a division by zero.",
        )
    texts = []
    size, least = max(abs(forward), abs(reverse)), limits.size / scale
    if abs(forward - reverse) > limits.rtol_modes * (size + least):
        texts.append(
            f"{name}: forward and reverse mode part by {_percent(forward - reverse, size)}: {forward:.7g} and"
            f" {reverse:.7g}. Look for an own rule of only one mode (custom_vjp, custom_jvp) in what fn calls."
        )
    wrong = {
        mode: value
        for mode, value in derivatives.items()
        if abs(value - guess.value)
        > limits.rtol * (max(abs(value), abs(guess.value)) + _TINY * least) + 3 * guess.error
    }
    if wrong:
        value = max(wrong.values(), key=lambda v: abs(v - guess.value))
        who = "both modes give" if len(wrong) == 2 else f"{next(iter(wrong))} gives"
        why = (
            "The number is cut off from the result: look for stop_gradient, float() or numpy in fn and in the scene."
            if value == 0
            else "Look for stop_gradient, for an own derivative rule (custom_jvp, custom_vjp), and for loose tolerances"
            " or a large dt of simulate."
        )
        texts.append(
            f"{name}: {who} {value:.7g}, but the differences {guess.value:.7g} (+- {guess.error:.1g}): off by"
            f" {_percent(value - guess.value, guess.value)}. {why}"
        )
    return tuple(texts)


def adjoint(names: tuple[str, ...]) -> str:
    """What adjoints of diffrax do to derivatives."""
    return (
        f"The steps of a run with adjoint={' or '.join(names)} keep the tolerance of the motion alone, and derivatives"
        " are wrong where little moves. Leave adjoint out: the default keeps the tolerance of the derivatives, too."
    )


def _change(history: History | None, k: int) -> str | None:
    if history is None or k >= len(history.changes):
        return None
    before, after = history.changes[k]
    return f"{_MODES[before]} to {_MODES[after]} at t = {history.t[k]:.6g}"


def _run(index: int) -> str:
    return f" in run {index + 1}" if index else ""


def _percent(change: float, of: float) -> str:
    return f"{100 * abs(change / of):.2g} %" if of else f"{abs(change):.2g}"
