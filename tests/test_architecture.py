"""The rules of the code base that a reader cannot be expected to check by eye."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxmodsim

from .helpers import deep

ROOT = Path(jaxmodsim.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))

# Three circles: the core simulates; applications use runs; the laboratory (stress tests, second simulators, studies) is
# never in the wheel. Rooms are in the order of their imports: a room imports only rooms above it, imports for type
# checkers included; what it takes from another room is among that room's public names. `_core` has none: all of it is
# private to the package. The number is the budget of lines of a room: to raise it is a decision, whose commit says why.
CORE = {"_core": 3488, "mechanics": 1600, "friction": 3020, "scene": 4083, "solvers": 4179, "simulation": 3248}
APPLICATIONS = {
    "metrics": 633,
    "analysis": 2136,
    "orbits": 3122,
    "identify": 9622,
    "sweeps": 2093,
    "export": 1869,
    "control": 793,
    "problems": 2835,
    "plot": 1715,
    "cli": 3336,
}
LABORATORY = ("tests", "bench")
ROOMS = (*CORE, *APPLICATIONS)
# Folders of identification in the order of the flow of data: one imports only those before it.
STAGES = ("data", "model", "estimate", "uncertainty", "selection", "design")

# Names that their libraries do not document, and the one module that may use them: a release that lacks one then turns
# off what is built on it. Tests, benches and examples keep to this, too, as they show whether a new release works.
PRIVATE = re.compile(
    r"^(jax\.(extend|interpreters)\b|jaxlib\.|equinox\.internal\b|(jax|equinox|diffrax)\.(\w+\.)*_[a-z]|sys\.excepthook$)"
    r"|\._(cache_size|loop)$"
)
COMPAT = ROOT / "_core" / "compat.py"
SCRIPTS = [
    path for each in ("tests", "bench", "examples", "docs") for path in (Path(__file__).parents[1] / each).rglob("*.py")
]

MAX_FILE_LINES = 600
MAX_FUNCTION_LINES = 80
LONG_FUNCTIONS: dict[str, str] = {}  # "file:function" -> reason


def room_of(path: Path) -> str:
    return path.relative_to(ROOT).with_suffix("").parts[0]


def own_imports(path: Path, node: ast.AST) -> Iterator[str]:
    """Modules of this package that an import statement names, as dotted paths from its root."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            if alias.name.split(".")[0] == "jaxmodsim":
                yield alias.name.removeprefix("jaxmodsim").lstrip(".")
    elif isinstance(node, ast.ImportFrom):
        if node.level:
            folder = path.parent.relative_to(ROOT).parts
            base = folder[: len(folder) - (node.level - 1)]
        elif (node.module or "").split(".")[0] == "jaxmodsim":
            base = ()
        else:
            return
        module = (node.module or "").removeprefix("jaxmodsim").lstrip(".")
        stem = ".".join((*base, *([module] if module else [])))
        if stem:
            yield stem
        else:  # from . import name, from jaxmodsim import name
            yield from (alias.name for alias in node.names)


def names_of_others(source: str) -> Iterator[str]:
    """Dotted names of imports and of attributes, which begin with the name of their module."""
    nodes = list(ast.walk(ast.parse(source)))
    modules = {a.asname: a.name for node in nodes if isinstance(node, ast.Import) for a in node.names if a.asname}

    def dotted(node: ast.AST) -> str:
        if isinstance(node, ast.Attribute):
            return f"{dotted(node.value)}.{node.attr}"
        return modules.get(node.id, node.id) if isinstance(node, ast.Name) else ""

    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Attribute):
            yield dotted(node)


def statements(path: Path, kind: tuple[type[ast.AST], ...]) -> list[ast.AST]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kind)]


def each_file(paths: list[Path]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("path", paths, ids=lambda p: str(p.relative_to(ROOT)))


@pytest.mark.quick
def test_every_file_stands_in_a_room() -> None:
    assert {room_of(path) for path in FILES} - {"__init__"} == set(ROOMS)


@pytest.mark.quick
def test_names_that_load_later_are_those_that_type_checkers_see() -> None:
    branch = next(node for node in ast.parse((ROOT / "__init__.py").read_text()).body if isinstance(node, ast.If))
    imports = [node for node in branch.body if isinstance(node, ast.ImportFrom)]
    seen = {(node.module, alias.name) for node in imports for alias in node.names}
    later = {(folder, name) for folder, names in jaxmodsim._LATER.items() for name in names}
    folders = {(None, name) for name in ("metrics", "plot", "problems", "sweeps")}
    assert seen == later | folders
    for _, name in seen:
        assert getattr(jaxmodsim, name) is not None
    names: dict[str, object] = {}
    exec("from jaxmodsim import *", names)
    assert {name for _, name in later} <= {*names}


def loaded_by(code: str) -> set[str]:
    """Modules that a fresh interpreter has loaded after a piece of code."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.quick
def test_simulate_loads_no_more_than_a_simulation_needs() -> None:
    loaded = loaded_by("from jaxmodsim import simulate")
    rooms = {name.split(".")[1] for name in loaded if name.startswith("jaxmodsim.")}
    assert rooms == set(CORE)


@pytest.mark.quick
def test_problems_do_not_wait_for_scipy() -> None:
    assert "scipy" not in loaded_by("from jaxmodsim.problems import named_problems")


@pytest.mark.quick
@pytest.mark.parametrize(
    "words",
    [["--help"], ["fit", "--help"], ["sweep", "--help"], ["fit", "none.csv"], ["export", "none.toml", "a.fmu"]],
    ids=" ".join,
)
def test_help_and_missing_files_load_nothing_that_takes_long(words: list[str]) -> None:
    arguments = ["jaxmodsim", *words]
    run = f"import sys; sys.argv = {arguments}\nfrom jaxmodsim.cli import main\ntry: main()\nexcept SystemExit: pass"
    slow = {"jax", "numpy", "scipy", "pandas", "matplotlib", "diffrax"}
    assert not slow & loaded_by(run)


@each_file([path for path in FILES if path != ROOT / "__init__.py"])
def test_rooms_import_only_those_above(path: Path) -> None:
    room = room_of(path)
    for node in statements(path, (ast.Import, ast.ImportFrom)):
        for module in own_imports(path, node):
            target = module.split(".")[0]
            assert target in ROOMS[: ROOMS.index(room) + 1], f"{room} imports {module}"
            public = target == "_core" or "._" not in module
            assert target == room or public, f"{room} reaches into {module}; import it from {target}"


@each_file([path for path in FILES if room_of(path) in CORE])
def test_the_core_imports_no_application(path: Path) -> None:
    for node in statements(path, (ast.Import, ast.ImportFrom)):
        for module in own_imports(path, node):
            assert module.split(".")[0] in CORE, f"the core imports {module}"


@each_file(FILES)
def test_the_package_imports_nothing_of_the_laboratory(path: Path) -> None:
    for node in statements(path, (ast.Import, ast.ImportFrom)):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", None) or ""]
        assert not [name for name in names if name.split(".")[0] in LABORATORY]


@pytest.mark.quick
def test_the_wheel_holds_the_package_alone() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    assert project["tool"]["hatch"]["build"]["targets"]["wheel"] == {"packages": ["jaxmodsim"]}


@pytest.mark.parametrize(("room", "lines"), [*CORE.items(), *APPLICATIONS.items()])
def test_a_room_keeps_its_budget_of_lines(room: str, lines: int) -> None:
    found = sum(len(path.read_text().splitlines()) for path in FILES if room_of(path) == room)
    assert found <= lines, f"{room} has {found} lines"


@each_file(sorted(ROOT.joinpath("identify").glob("*/*.py")))
def test_data_flow_one_way_through_identification(path: Path) -> None:
    stage = path.parent.name
    for node in statements(path, (ast.Import, ast.ImportFrom)):
        for module in own_imports(path, node):
            room, _, inside = module.partition(".")
            allowed = STAGES[: STAGES.index(stage) + 1]
            assert room != "identify" or inside.split(".")[0] in allowed, f"{stage} imports {module}"


@each_file(FILES)
def test_only_plot_imports_matplotlib(path: Path) -> None:
    for node in statements(path, (ast.Import, ast.ImportFrom)):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", None) or ""]
        if any(name.split(".")[0] == "matplotlib" for name in names):
            assert room_of(path) == "plot"


def test_only_one_module_uses_private_names_of_others() -> None:
    found = {
        str(path): names
        for path in [*FILES, *SCRIPTS]
        if path != COMPAT and (names := sorted(set(filter(PRIVATE.search, names_of_others(path.read_text())))))
    }
    assert not found, f"import these from jaxmodsim._core.compat, behind a probe: {found}"


@each_file([path for path in FILES if room_of(path) != ROOMS[-1]])
def test_no_import_of_our_own_inside_functions(path: Path) -> None:
    """The last room may: its `--help` does not wait for JAX, and since nothing imports it, no circle can hide there."""
    for function in statements(path, (ast.FunctionDef, ast.AsyncFunctionDef)):
        for node in ast.walk(function):
            assert not list(own_imports(path, node)), f"line {getattr(node, 'lineno', '?')}"


@each_file(FILES)
def test_files_and_functions_are_short(path: Path) -> None:
    """Lines of a function are counted without its docstring."""
    assert len(path.read_text().splitlines()) < MAX_FILE_LINES
    for node in statements(path, (ast.FunctionDef, ast.AsyncFunctionDef)):
        assert isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        lines = (node.end_lineno or node.lineno) - node.lineno + 1
        if ast.get_docstring(node) is not None:
            lines -= (node.body[0].end_lineno or 0) - node.body[0].lineno + 1
        allowed = f"{path.relative_to(ROOT)}:{node.name}" in LONG_FUNCTIONS
        assert lines < MAX_FUNCTION_LINES or allowed, f"{node.name} has {lines} lines"


@each_file([path for path in FILES if room_of(path) not in ("_core", "__init__")])
def test_public_modules_are_those_that_their_room_names(path: Path) -> None:
    room = ast.parse((ROOT / room_of(path) / "__init__.py").read_text()).body
    modules = {a.name for node in room if isinstance(node, ast.ImportFrom) and not node.module for a in node.names}
    assert path.stem.startswith("_") or path.stem in modules


def test_classes_are_abstract_or_final() -> None:
    bases: dict[str, list[str]] = {}
    for path in FILES:
        for node in statements(path, (ast.ClassDef,)):
            assert isinstance(node, ast.ClassDef)
            names = [base.value if isinstance(base, ast.Subscript) else base for base in node.bases]
            bases[node.name] = [n.id if isinstance(n, ast.Name) else getattr(n, "attr", "") for n in names]
    derived = {
        name: base
        for name, of in bases.items()
        for base in of
        if base in bases and not base.lstrip("_").startswith("Abstract")
    }
    assert not derived, f"derived from a concrete class: {derived}"


def test_a_class_has_one_meaning() -> None:
    """No two classes have one name, private ones included."""
    files: dict[str, set[str]] = {}
    for path in FILES:
        for node in statements(path, (ast.ClassDef,)):
            assert isinstance(node, ast.ClassDef)
            files.setdefault(node.name.lstrip("_"), set()).add(str(path.relative_to(ROOT)))
    twice = {name: where for name, where in files.items() if len(where) > 1}
    assert not twice, f"classes of one name: {twice}"


def test_the_listed_deep_tests_exist() -> None:
    for line in deep.listed():
        path, _, name = line.partition("::")
        text = (Path(__file__).parents[1] / path).read_text()
        assert not name or f"def {name.split('[')[0]}(" in text, f"tests/deep.txt: {line} does not exist."


def test_the_rules_can_be_broken(tmp_path: Path) -> None:
    """The readers of imports above see what they should."""
    del tmp_path
    inside = ROOT / "friction" / "_law.py"
    cases = {
        "from ..mechanics import x": ["mechanics"],
        "from .._core.safe import x": ["_core.safe"],
        "from ._law import x": ["friction._law"],
        "from .. import scene": ["scene"],
        "import jaxmodsim.scene": ["scene"],
        "from jaxmodsim import scene": ["scene"],
        "from jaxmodsim.scene import Scene": ["scene"],
        "import jax": [],
        "from jax import numpy": [],
    }
    for source, expected in cases.items():
        assert list(own_imports(inside, ast.parse(source).body[0])) == expected, source
    private = (
        "import jax._src.core",
        "from jax.interpreters import mlir",
        "import jax\njax.extend.core.Literal",
        "from jaxlib.mlir import ir",
        "import equinox as eqx\neqx.internal.while_loop",
        "from diffrax import _integrate",
        "import diffrax as dfx\ndfx.Tsit5()._loop",
        "import sys\nsys.excepthook = print",
        "jax.jit(abs)._cache_size()",
    )
    public = "import jax.core as c\nfrom jax import lax\nimport diffrax as d\nd.ODETerm\nself._loops\njax.__version__"
    assert all(any(map(PRIVATE.search, names_of_others(source))) for source in private)
    assert not any(map(PRIVATE.search, names_of_others(public)))
