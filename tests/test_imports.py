"""Rooms import one way: a folder or file of e2rl knows only what comes before it."""

import ast
import runpy
from graphlib import TopologicalSorter
from pathlib import Path

import e2rl
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.idm_planner import IDMEgo
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from tests.synthetic import make_scenes

PACKAGE = Path(e2rl.__file__).parent
ORDER = (  # of the rooms
    *(
        "run",
        "scenes",
        "sim",
        "prior",
        "planners",
        "metrics",
        "traffic",
        "driving",
        "search",
        "tail",
        "evaluation",
    ),
    *("learning", "report", "api", "commands"),
)


def imports() -> list[tuple[str, str, str]]:
    """(room, imported room, file:line) of every import between rooms, those inside
    functions included."""
    result = []
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).with_suffix("").parts[0]
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [
                    f"{'.' * node.level}{node.module or ''}.{alias.name}"
                    for alias in node.names
                ]
            else:
                continue
            for first, *rest in (name.split(".") for name in names):
                where = f"{path.relative_to(PACKAGE.parent)}:{node.lineno}"
                assert first, f"{where}: a relative import; name the module in full"
                if first == "e2rl" and rest and rest[0] != room:
                    result.append((room, rest[0], where))
    return result


def test_every_room_has_its_place_in_the_order():
    rooms = {
        path.stem
        for path in PACKAGE.iterdir()
        if path.suffix == ".py" or any(path.glob("*.py"))
    }
    assert rooms - {"__init__", "scripts"} == set(
        ORDER
    )  # scripts: installed copies of train.py and evaluate.py


def test_rooms_import_only_from_rooms_before_them():
    backwards = [
        f"{where}: {room} imports {other}"
        for room, other, where in imports()
        if ORDER.index(other) >= ORDER.index(room)
    ]
    assert not backwards, "\n".join(backwards)


def test_rooms_have_no_cycle():
    graph: dict[str, set[str]] = {}
    for room, other, _ in imports():
        graph.setdefault(room, set()).add(other)
    assert set(TopologicalSorter(graph).static_order()) <= set(
        ORDER
    )  # raises CycleError where there is one


def test_learning_can_be_imported_after_an_ego_was_built():
    """TorchRL changes a module class when it is first built: other classes must not
    copy its attributes."""
    EgoPolicy(IDMEgo(), DrivingEnv(make_scenes(1), SimSettings(), 1, agents=True))
    path = PACKAGE / "learning" / "rounds" / "policy.py"
    assert "PolicyImprovement" in runpy.run_path(str(path))
