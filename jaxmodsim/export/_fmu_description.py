"""modelDescription.xml of an FMU: variables, units and structure."""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree import ElementTree as et

# Exponents of units in base units of FMI.
_BASE: dict[str, dict[str, int]] = {
    **{base: {base: 1} for base in ("m", "rad", "s", "kg", "A", "K")},
    "N": {"kg": 1, "m": 1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "Hz": {"s": -1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "1": {},
    "-": {},
}
# Factor and unit of other units.
_DERIVED = {"km": (1e3, "m"), "cm": (1e-2, "m"), "mm": (1e-3, "m"), "um": (1e-6, "m"), "nm": (1e-9, "m")}
_DERIVED |= {"in": (0.0254, "m"), "ft": (0.3048, "m"), "mrad": (1e-3, "rad"), "urad": (1e-6, "rad")}
_DERIVED |= {"deg": (math.pi / 180, "rad"), "rev": (2 * math.pi, "rad"), "ms": (1e-3, "s"), "us": (1e-6, "s")}
_DERIVED |= {"min": (60.0, "s"), "h": (3600.0, "s"), "g": (1e-3, "kg"), "kN": (1e3, "N"), "mN": (1e-3, "N")}
_DERIVED |= {"kJ": (1e3, "J"), "kW": (1e3, "W"), "kPa": (1e3, "Pa"), "MPa": (1e6, "Pa"), "bar": (1e5, "Pa")}
_DERIVED |= {"mA": (1e-3, "A"), "mV": (1e-3, "V")}


class FmuVariable(NamedTuple):
    """A variable of an FMU.

    - `causality`, `variability`: as in FMI 3.0; `start`: None if it is computed.
    - `derivative`: value reference of the state whose rate this is.
    """

    name: str
    reference: int
    causality: str
    variability: str
    start: float | None = None
    unit: str = ""
    derivative: int | None = None
    least: float | None = None
    integer: bool = False


def base_unit(text: str) -> tuple[float, dict[str, int]] | None:
    """Factor and exponents of a unit such as `N s/m`, in base units of FMI; None if it has none."""
    factor, exponents, sign = 1.0, {}, 1
    for part in re.findall(r"[/*·⋅\s]+|[^/*·⋅\s]+", text.strip()):
        if not part.strip(" *·⋅/"):
            sign = -1 if "/" in part else 1
            continue
        match = re.fullmatch(r"(.+?)(?:\^?([-+]?\d+))?", part)
        assert match is not None
        symbol, power = (part, 1) if part == "1" else (match[1], int(match[2] or 1))
        scale, symbol = _DERIVED.get(symbol, (1.0, symbol))
        if symbol not in _BASE:
            return None
        factor *= scale ** (sign * power)
        for base, each in _BASE[symbol].items():
            exponents[base] = exponents.get(base, 0) + sign * power * each
    return factor, {base: each for base, each in exponents.items() if each}


def describe(name: str, token: str, variables: Sequence[FmuVariable], guards: range, run: dict[str, float]) -> str:
    """The text of modelDescription.xml.

    **Arguments:**

    - `name`: the model identifier; `token`: the instantiation token.
    - `variables`: all variables, in the order of their value references.
    - `guards`: value references of the event indicators.
    - `run`: attributes of the default experiment.
    """
    root = et.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=name,
        instantiationToken=token,
        generationTool="jaxmodsim",
        variableNamingConvention="flat",
    )
    both = {
        "modelIdentifier": name,
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
        "providesDirectionalDerivatives": "true",
        "providesAdjointDerivatives": "true",
    }
    et.SubElement(root, "ModelExchange", both, needsCompletedIntegratorStep="true")
    et.SubElement(
        root,
        "CoSimulation",
        both,
        canHandleVariableCommunicationStepSize="true",
        providesIntermediateUpdate="true",
        mightReturnEarlyFromDoStep="true",
        canReturnEarlyAfterIntermediateUpdate="true",
        hasEventMode="true",
    )
    units = et.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(x.unit for x in variables if x.unit):
        definition = et.SubElement(units, "Unit", name=unit)
        base = base_unit(unit)
        if base is not None:
            scale = {} if base[0] == 1.0 else {"factor": repr(base[0])}
            et.SubElement(definition, "BaseUnit", {key: str(x) for key, x in base[1].items()} | scale)
    et.SubElement(et.SubElement(root, "LogCategories"), "Category", name="error", description="Reasons of errors")
    et.SubElement(root, "DefaultExperiment", {key: repr(float(x)) for key, x in run.items()})
    listed = et.SubElement(root, "ModelVariables")
    for each in variables:
        _add_variable(listed, each)
    _add_structure(root, variables, guards)
    et.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + et.tostring(root, encoding="unicode") + "\n"


def _add_variable(listed: et.Element, each: FmuVariable) -> None:
    attributes = {"name": each.name, "valueReference": str(each.reference), "causality": each.causality}
    attributes["variability"] = each.variability
    if each.causality not in ("independent", "input", "parameter"):
        attributes["initial"] = "calculated" if each.start is None else "exact"
    if each.unit and not each.integer:
        attributes["unit"] = each.unit
    if each.least is not None:
        attributes["min"] = repr(each.least)
    if each.derivative is not None:
        attributes["derivative"] = str(each.derivative)
    if each.start is not None:
        attributes["start"] = repr(each.start)
    et.SubElement(listed, "Int32" if each.integer else "Float64", attributes)


def _add_structure(root: et.Element, variables: Sequence[FmuVariable], guards: range) -> None:
    structure = et.SubElement(root, "ModelStructure")

    def add(kind: str, references: Sequence[int]) -> None:
        for reference in references:
            et.SubElement(structure, kind, valueReference=str(reference))

    outputs = [x for x in variables if x.causality == "output"]
    rates = [x.reference for x in variables if x.derivative is not None]
    add("Output", [x.reference for x in outputs])
    add("ContinuousStateDerivative", rates)
    add("InitialUnknown", [*(x.reference for x in outputs if x.start is None), *rates])
    add("EventIndicator", guards)
