"""`e2rl skeleton`: from pairwise risk to an active chain, for one coalition of a real
rollout (Sec. IV-A).

Three panels: the times to collision in the reference rollout, when the links of the
coalition weigh most; the risk graph at that time; the chain when it was chosen, with
the paths that were driven after it.

A second figure is the paper's qualitative skeleton: what was driven without and with
anchoring, side by side, as times to collision and as the chain.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from torch import Tensor

from e2rl.evaluation.plan import begin
from e2rl.evaluation.protocol import SEEDS_APART, Method, run_protocol
from e2rl.report import drawing
from e2rl.report.drawing import TrafficMap, Trail, add_legend, new_panels, save_figure
from e2rl.report.picture import shorten
from e2rl.run.command import run_command
from e2rl.run.errors import InputError
from e2rl.run.run import Run
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollout_file import ROLLOUTS, Rollout, rollout_name
from e2rl.traffic.e2.skeleton import Selection, chain_depth
from e2rl.traffic.e2.topology import STRIDE, pair_weights
from e2rl.traffic.grouping import take_rows

SIDE, GAP, HEAD, FOOT = (
    600,
    12,
    62,
    34,
)  # points: of a panel, between panels, above and below them
NODES = 10  # of the matrix at most
SHOWN_STEPS = 50  # steps of what was driven, as long as the reference rollout
MARGIN, SMALLEST, LARGEST = (
    30.0,
    60.0,
    140.0,
)  # m: around the coalition, and a map's least and greatest side
CANDIDATE = drawing.VULNERABLE
FEASIBLE = "#2e8b57"
ON_TOP = 10  # drawing order of edges, arrows and names, above the map
LEGEND = {
    "ego": drawing.EGO,
    "coalition C*": drawing.ADVERSARY,
    "candidate of the topology": CANDIDATE,
}
LEGEND |= {"feasible, no candidate": FEASIBLE, "others": drawing.BACKGROUND}
Part = tuple[str, Callable[[Axes], None]]  # of a figure: its caption, and what draws it


@dataclass
class SkeletonPicture:
    """The figure of a selection (B = 1) in a rollout.

    `time` [s] and `weights` [V, V] are those of the step of the reference rollout at
    which the coalition's links weigh most, `risky` [V, 4] the states there; `now` [N,
    4] are the rollout's states when the coalition was chosen.
    """

    rollout: Rollout
    selection: Selection

    def __post_init__(self):
        chosen = self.selection
        self.settings = chosen.settings
        masks = (chosen.coalition, chosen.candidates, chosen.feasible)
        self.coalition, self.candidates, self.feasible = (
            mask[0].cpu().numpy() for mask in masks
        )
        self.target = chosen.target[0].tolist()
        self.step = int(chosen.step)
        # Among steps of equal risk of the links, the one with the greatest risk of all
        # pairs.
        moment = int(
            (link_risk(chosen)[0] + 1e-6 * chosen.weights[0].sum((1, 2))).argmax()
        )
        self.time = float(chosen.moments[0, moment])
        self.weights = chosen.weights[0, moment].cpu().numpy()
        self.risky = chosen.reference[0, moment].cpu().numpy()
        self.now = self.rollout.states[self.step]
        self.members = np.flatnonzero(self.coalition).tolist()

    @classmethod
    def driven(cls, rollout: Rollout, selection: Selection) -> "SkeletonPicture":
        """The same with what the rollout drove in the five seconds after the choice in
        place of the reference."""
        start = int(selection.step)
        count = min(selection.weights.shape[-1], rollout.states.shape[1])
        steps = np.arange(
            start, min(start + SHOWN_STEPS, len(rollout.states) - 1) + 1, STRIDE
        )
        states, valid = (
            torch.as_tensor(value[steps, :count])
            for value in (rollout.states, rollout.valid)
        )
        weights = pair_weights(
            states,
            valid,
            size=torch.as_tensor(rollout.size[:count]),
            settings=selection.settings,
        )
        moments = torch.as_tensor((steps - start) * rollout.dt)
        return cls(
            rollout,
            replace(
                selection,
                reference=states[None],
                weights=weights[None],
                moments=moments[None],
            ),
        )

    def nodes(self) -> list[int]:
        """Vehicles of the matrix: the ego, the coalition, then those with the heaviest
        edges."""
        own = [0, *self.members]
        edges = self.weights * (self.weights >= self.settings.edge_threshold)
        others = [
            i
            for i in np.argsort(-edges.sum(1), kind="stable").tolist()
            if edges[i].any() and i not in own
        ]
        return own + sorted(others[: max(NODES - len(own), 0)])

    def colour(self, agent: int) -> str:
        if agent == 0:
            return drawing.EGO
        masks = (self.coalition, self.candidates, self.feasible)
        for mask, colour in zip(
            masks, (drawing.ADVERSARY, CANDIDATE, FEASIBLE), strict=True
        ):
            if agent < len(mask) and mask[agent]:
                return colour
        return drawing.BACKGROUND

    def ttc(self, weight: float) -> float:
        """Time to collision [s] of a pair of this weight, eq. (ttc_weight_t) inverted."""
        return max(
            0.0,
            self.settings.tau_max
            - self.settings.beta * math.log(weight / (1 - weight)),
        )

    def figure(self) -> Figure:
        """The three panels beside each other, under their titles."""
        rollout = self.rollout
        title = (
            f"{shorten(rollout.scene_id)}   seed {rollout.seed}   intensity {rollout.eta:g}   "
            f"{rollout.method} vs {rollout.ego_policy}   chosen at {self.step * rollout.dt:.1f} s"
        )
        gap = f"{self.settings.clearance:g} m"
        longest = f"{self.ttc(self.settings.edge_threshold):.1f} s"
        parts = {
            f"time to a gap of {gap} [s], {self.time:.1f} s into the reference rollout": self.matrix,
            f"risk graph at that time, edges of TTC < {longest}": self.graph,
            "active chain, and the paths driven after it": self.chain,
        }
        return panels(title, list(parts.items()))

    def matrix(self, axes: Axes) -> None:
        """TTC of every pair of nodes, red by weight; the links of the coalition are
        framed."""
        axes.set_axis_off()
        table = axes.inset_axes((0.09, 0.02, 0.89, 0.89))
        nodes = self.nodes()
        weights = self.weights[np.ix_(nodes, nodes)]
        reds = LinearSegmentedColormap.from_list(
            "risk", (drawing.GROUND, drawing.CONTACT)
        )
        colours = reds.with_extremes(bad=drawing.BACKGROUND)
        others = np.ma.masked_where(np.eye(len(nodes), dtype=bool), weights)
        table.pcolormesh(
            others, cmap=colours, vmin=0, vmax=1, edgecolors=drawing.PANEL, linewidth=1
        )
        font = min(16, 180 / len(nodes))
        for row, column in np.argwhere(others.filled(0) > 0):
            weight = float(weights[row, column])
            ink = drawing.PANEL if weight > 0.6 else drawing.INK
            text = f"{self.ttc(weight):.1f}"
            table.text(
                column + 0.5,
                row + 0.5,
                text,
                color=ink,
                fontsize=font,
                ha="center",
                va="center",
            )
        for agent in self.members:
            corner = (nodes.index(self.target[agent]), nodes.index(agent))
            table.add_patch(
                Rectangle(
                    corner,
                    1,
                    1,
                    fill=False,
                    edgecolor=drawing.INK,
                    linewidth=4,
                    zorder=3,
                )
            )
        centres = np.arange(len(nodes)) + 0.5
        names = [name(agent) for agent in nodes]
        table.set(
            xticks=centres,
            xticklabels=names,
            yticks=centres,
            yticklabels=names,
            ylim=(len(nodes), 0),
        )
        table.tick_params(
            top=True, labeltop=True, labelbottom=False, length=0, labelsize=14
        )
        table.spines[:].set_visible(False)
        for labels in (table.get_xticklabels(), table.get_yticklabels()):
            for agent, label in zip(nodes, labels, strict=True):
                label.set_color(self.colour(agent))

    def graph(self, axes: Axes) -> None:
        """The reference rollout at the time of the risk, with the edges of the risk
        graph."""
        self.draw_map(axes, self.risky, trails=[])
        for i, j in np.argwhere(
            np.tril(self.weights, -1) >= self.settings.edge_threshold
        ):
            ends = self.risky[[i, j]]
            weight = float(self.weights[i, j])
            axes.plot(
                *ends[:, :2].T,
                color=drawing.INK,
                linewidth=1 + 4 * weight,
                zorder=ON_TOP,
            )

    def chain(self, axes: Axes) -> None:
        """The moment of the choice: who acts on whom, and how the coalition and the ego
        drove from there."""
        states = self.rollout.states[self.step :, :, :2]
        valid = self.rollout.valid[self.step :]
        own = [*self.members, 0]
        trails = [
            Trail(states[valid[:, agent], agent], self.colour(agent), width=0.6)
            for agent in own
        ]
        self.draw_map(axes, self.now, trails=trails)
        head = {
            "arrowstyle": "-|>",
            "mutation_scale": 30,
            "color": drawing.INK,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        for agent in self.members:
            start = self.now[agent, :2]
            end = self.now[self.target[agent], :2]
            axes.plot(
                *np.stack([start, end], 1),
                color=drawing.INK,
                linewidth=4,
                zorder=ON_TOP,
            )
            axes.annotate(
                "", start + 0.8 * (end - start), start, arrowprops=head, zorder=ON_TOP
            )

    def draw_map(self, axes: Axes, states: np.ndarray, trails: list[Trail]) -> None:
        """Vehicles at their states, with numbers beside the nodes; the coalition and
        the ego lie on top.

        Both maps show the square that holds the ego and the coalition at both times.
        """
        own = [0, *self.members]
        points = np.concatenate([self.now[own, :2], self.risky[own, :2]])
        side = float(np.clip(np.ptp(points, axis=0).max() + MARGIN, SMALLEST, LARGEST))
        shown = [
            agent
            for agent in range(len(states))
            if self.rollout.valid[self.step, agent]
        ]
        shown.sort(key=lambda agent: (self.colour(agent) != drawing.BACKGROUND, -agent))
        sizes = self.rollout.size
        shapes = [
            shape
            for i in shown
            for shape in drawing.vehicle(states[i], sizes[i], colour=self.colour(i))
        ]
        TrafficMap(axes, self.rollout, metres=side).show(
            (points.min(0) + points.max(0)) / 2, trails, shapes
        )
        outline = [withStroke(linewidth=4, foreground=drawing.PANEL)]
        for agent in self.nodes():
            x, y = states[agent, :2]
            text = axes.annotate(
                name(agent), (x, y), (13, 9), textcoords="offset points", fontsize=15
            )
            text.set(
                color=drawing.INK, path_effects=outline, zorder=ON_TOP + 1, clip_on=True
            )


def name(agent: int) -> str:
    return "ego" if agent == 0 else str(agent)


@dataclass
class LongestChain:
    """Keeps a method's selection with the longest chain; ties go to the largest
    coalition, then to the greatest risk between its members, then to the first.
    `longest`: that selection, B = 1; `first`: that of those at the start, where all
    methods are in the same state."""

    method: Method
    longest: Selection | None = None
    first: Selection | None = None
    ranks: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.method.traffic.on_decision = self

    def __call__(self, selection: Selection) -> None:
        depth = chain_depth(selection.target).amax(1)
        size = selection.coalition.sum(1)
        ranks = torch.stack(
            [depth.double(), size.double(), link_risk(selection).amax(1).double()], 1
        )
        for row, rank in enumerate(map(tuple, ranks.tolist())):
            for kind in ("longest", *(("first",) if selection.step[row] == 0 else ())):
                if rank > self.ranks.get(kind, (0, 0, 0)):
                    setattr(self, kind, take_rows(selection, torch.tensor([row])))
                    self.ranks[kind] = rank

    def figure(self, scenes: SceneSet, ego_name: str, folder: Path) -> Figure:
        """The figure of the longest selection and its rollout, read from a run's
        folder; InputError if no adversary was chosen."""
        if self.longest is None:
            raise InputError(
                f"skeleton: {self.method.name} at eta={self.method.eta:g} chose no adversary in any scene; name e2 "
                "first in methods, at an eta above 0, and evaluate more scenes, or name one with scene="
            )
        return SkeletonPicture(
            rollout_of(
                self.longest,
                self.method,
                scenes=scenes,
                ego_name=ego_name,
                folder=folder,
            ),
            self.longest,
        ).figure()

    def beside(
        self, other: Method, scenes: SceneSet, ego_name: str, folder: Path
    ) -> Figure | None:
        """The coalition of `first` in the rollouts of another method (left) and of this
        one: times to collision and chain of each; None where no adversary was chosen at
        the start."""
        if self.first is None:
            return None
        parts: list[Part] = []
        for method in (other, self.method):
            picture = SkeletonPicture.driven(
                rollout_of(
                    self.first, method, scenes=scenes, ego_name=ego_name, folder=folder
                ),
                self.first,
            )
            parts.append(
                (
                    f"{method.name}: TTC {picture.time:.1f} s after the start [s]",
                    picture.matrix,
                )
            )
            parts.append(("chain, and the paths driven", picture.chain))
        title = f"{shorten(picture.rollout.scene_id)}   the same coalition under {other.name} and {self.method.name}"
        return panels(title, parts)


def panels(title: str, parts: Sequence[Part]) -> Figure:
    """The parts beside each other under their captions; above them a title, below them
    what the colours mean."""
    figure, axes = new_panels(len(parts), SIDE, gap=GAP, head=HEAD, foot=FOOT)
    figure.suptitle(title, x=0.004, y=0.985, ha="left", fontsize=15, color=drawing.INK)
    for panel, (caption, draw) in zip(axes, parts, strict=True):
        panel.set_title(
            caption, loc="left", x=8 / SIDE, fontsize=14, color=drawing.MUTED
        )
        draw(panel)
    add_legend(figure, LEGEND, size=13)
    return figure


def rollout_of(
    selection: Selection, method: Method, scenes: SceneSet, ego_name: str, folder: Path
) -> Rollout:
    """The rollout under a method in the scene and with the seed of a selection (B = 1),
    read from a run's folder."""
    seed, scene = divmod(int(selection.seed), SEEDS_APART)
    identity = {"method": method.name, "ego_policy": ego_name, "eta": method.eta}
    return Rollout.read(
        Path(folder)
        / ROLLOUTS
        / rollout_name(identity | {"scene_id": scenes.scene_id[scene], "seed": seed})
    )


def link_risk(selection: Selection) -> Tensor:
    """Sum [B, T'] of the weights between the coalition's members and their targets, at
    each time."""
    onto = selection.target.clamp(min=0)[:, None, :, None].expand(
        *selection.weights.shape[:3], 1
    )
    return (
        selection.weights.gather(3, onto)[..., 0] * selection.coalition[:, None]
    ).sum(-1)


def draw(run: Run) -> None:
    """Roll out every scene in this process and draw the longest chain selected; with a
    second method also the longest one of the start under both."""
    plan = begin(run)
    chain = LongestChain(plan.methods[0])
    run_protocol(
        plan.setup,
        plan.methods,
        seeds=plan.asked.seeds,
        folder=run.folder,
        only=plan.only,
    )
    where = plan.scenes, plan.setup.ego_name, run.folder
    figures = {"skeleton": chain.figure(*where)}
    for other in plan.methods[1:2]:
        if figure := chain.beside(other, *where):
            figures["anchoring"] = figure
    for name, figure in figures.items():
        save_figure(run.folder / f"{name}.png", figure)
        print(f"drawn: {run.folder / f'{name}.png'}")


def main() -> None:
    """The command."""
    run_command("skeleton", draw)
