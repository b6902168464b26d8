"""The figure of the skeleton: from pairwise risk to an active chain, for one coalition
of a real rollout (Sec. IV-A).

Three panels: the times to collision in the reference rollout, when the links of the
coalition weigh most; the risk graph at that time; the chain when it was chosen, with
the paths that were driven after it.
"""

import math
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from torch import Tensor

from e2rl.driving.setup import SEED_STRIDE, Method
from e2rl.report import drawing
from e2rl.report.drawing import TrafficMap, Trail, add_legend, new_figure
from e2rl.report.picture import shorten
from e2rl.run.errors import InputError
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollout_file import ROLLOUTS, Rollout, rollout_name
from e2rl.traffic.e2.skeleton import Selection, chain_depth
from e2rl.traffic.grouping import take_rows

SIDE = 600  # points, of a panel
GAP = 12  # between panels
HEAD = 62  # above them
FOOT = 34  # below them
NODES = 10  # of the matrix at most
MARGIN = 30.0  # m around the coalition
SMALLEST = 60.0  # m, side of a map
LARGEST = 140.0  # m, side of a map
CANDIDATE = drawing.VULNERABLE
FEASIBLE = "#2e8b57"
ON_TOP = 10  # drawing order of edges, arrows and names, above the map
LEGEND = {
    "ego": drawing.EGO,
    "coalition C*": drawing.ADVERSARY,
    "candidate of the topology": CANDIDATE,
    "feasible, no candidate": FEASIBLE,
    "others": drawing.BACKGROUND,
}


class LongestChain:
    """Keeps a method's selection with the longest chain, B = 1; ties go to the largest
    coalition, then to the greatest risk between its members, then to the first."""

    def __init__(self, method: Method) -> None:
        self.method = method
        self.selection: Selection | None = None
        self.rank = [0.0, 0.0, 0.0]
        method.traffic.on_decision = self

    def __call__(self, selection: Selection) -> None:
        depth = chain_depth(selection.target).amax(1).double()
        members = selection.coalition.sum(1).double()
        risk = link_risk(selection).amax(1).double()
        for row, rank in enumerate(torch.stack([depth, members, risk], 1).tolist()):
            if rank > self.rank:
                self.selection = take_rows(selection, torch.tensor([row]))
                self.rank = rank

    def figure(self, scenes: SceneSet, ego: str, folder: Path) -> Figure:
        """The figure of the selection and its rollout, read from a run's folder;
        InputError if no adversary was chosen."""
        method = self.method
        if self.selection is None:
            raise InputError(
                f"skeleton: {method.name} at eta={method.eta:g} chose no adversary in "
                "any scene; name e2 first in methods, at an eta above 0, and evaluate "
                "more scenes, or name one with scene="
            )
        seed, scene = divmod(int(self.selection.seed), SEED_STRIDE)
        identity = {
            "method": method.name,
            "ego_policy": ego,
            "eta": method.eta,
            "scene_id": scenes.scene_id[scene],
            "seed": seed,
        }
        rollout = Rollout.read(folder / ROLLOUTS / rollout_name(identity))
        return SkeletonPicture(rollout, self.selection).figure()


def link_risk(selection: Selection) -> Tensor:
    """Sum [B, T'] of the weights between the coalition's members and their targets, at
    each time."""
    target = selection.target.clamp(min=0)[:, None, :, None]
    links = target.expand(*selection.weights.shape[:3], 1)
    weights = selection.weights.gather(3, links)[..., 0]
    return (weights * selection.coalition[:, None]).sum(-1)


class SkeletonPicture:
    """The figure of a selection (B = 1) in a rollout.

    `time` [s] and `weights` [V, V] are those of the step of the reference rollout at
    which the coalition's links weigh most, `risky` [V, 4] the states there; `chosen`
    [N, 4] are the rollout's states when the coalition was chosen, at `step`.
    """

    def __init__(self, rollout: Rollout, selection: Selection) -> None:
        # Among steps of equal risk of the links, the one with the greatest risk of all
        # pairs.
        risk = link_risk(selection)[0] + 1e-6 * selection.weights[0].sum((1, 2))
        moment = int(risk.argmax())
        self.rollout = rollout
        self.selection = selection
        self.settings = selection.settings
        self.time = float(selection.moments[0, moment])
        self.weights = selection.weights[0, moment].cpu().numpy()
        self.risky = selection.reference[0, moment].cpu().numpy()
        self.step = int(selection.step)
        self.chosen = rollout.states[self.step]
        self.target = selection.target[0].tolist()
        self.members = selection.coalition[0].nonzero()[:, 0].tolist()

    def nodes(self) -> list[int]:
        """Vehicles of the matrix: the ego, the coalition, then those with the heaviest
        edges."""
        shown = [0, *self.members]
        edges = self.weights * (self.weights >= self.settings.edge_threshold)
        total = edges.sum(1)
        others = [
            vehicle
            for vehicle in np.argsort(-total, kind="stable").tolist()
            if total[vehicle] and vehicle not in shown
        ]
        return shown + sorted(others[: max(NODES - len(shown), 0)])

    def colour(self, agent: int) -> str:
        if agent == 0:
            return drawing.EGO
        for mask, colour in (
            (self.selection.coalition, drawing.ADVERSARY),
            (self.selection.candidates, CANDIDATE),
            (self.selection.feasible, FEASIBLE),
        ):
            if agent < mask.shape[1] and mask[0, agent]:
                return colour
        return drawing.BACKGROUND

    def ttc(self, weight: float) -> float:
        """Time to collision [s] of a pair of a weight: eq. (ttc_weight_t) inverted."""
        odds = weight / (1 - weight)
        return max(0.0, self.settings.tau_max - self.settings.beta * math.log(odds))

    def figure(self) -> Figure:
        """The three panels beside each other, under their titles."""
        rollout = self.rollout
        longest = self.ttc(self.settings.edge_threshold)
        panels = {
            f"time to a gap of {self.settings.clearance:g} m [s], {self.time:.1f} s into "
            "the reference rollout": self.draw_matrix,
            f"risk graph at that time, edges of TTC < {longest:.1f} s": self.draw_graph,
            "active chain, and the paths driven after it": self.draw_chain,
        }
        height = HEAD + SIDE + FOOT
        figure = new_figure(len(panels) * (SIDE + GAP) - GAP, height)
        figure.suptitle(
            f"{shorten(rollout.scene_id)}   seed {rollout.seed}   intensity "
            f"{rollout.eta:g}   {rollout.method} vs {rollout.ego_policy}   chosen at "
            f"{self.step * rollout.dt:.1f} s",
            x=0.004,
            y=0.985,
            ha="left",
            fontsize=15,
            color=drawing.INK,
        )
        grid = {
            "left": 0,
            "right": 1,
            "bottom": FOOT / height,
            "top": 1 - HEAD / height,
            "wspace": GAP / SIDE,
        }
        axes = figure.subplots(1, len(panels), gridspec_kw=grid)
        for panel, (title, draw) in zip(axes, panels.items(), strict=True):
            panel.set_title(
                title, loc="left", x=8 / SIDE, fontsize=14, color=drawing.MUTED
            )
            draw(panel)
        add_legend(figure, LEGEND, size=13)
        return figure

    def draw_matrix(self, axes: Axes) -> None:
        """TTC of every pair of nodes, red by weight; the links of the coalition are
        framed."""
        axes.set_axis_off()
        table = axes.inset_axes((0.09, 0.02, 0.89, 0.89))
        nodes = self.nodes()
        count = len(nodes)
        weights = self.weights[np.ix_(nodes, nodes)]
        pairs = np.ma.masked_where(np.eye(count, dtype=bool), weights)
        reds = LinearSegmentedColormap.from_list(
            "risk", (drawing.GROUND, drawing.CONTACT)
        )
        table.pcolormesh(
            pairs,
            cmap=reds.with_extremes(bad=drawing.BACKGROUND),
            vmin=0,
            vmax=1,
            edgecolors=drawing.PANEL,
            linewidth=1,
        )
        for row, column in np.argwhere(pairs.filled(0) > 0):
            weight = float(weights[row, column])
            table.text(
                column + 0.5,
                row + 0.5,
                f"{self.ttc(weight):.1f}",
                color=drawing.PANEL if weight > 0.6 else drawing.INK,
                fontsize=min(16, 180 / count),
                ha="center",
                va="center",
            )
        for agent in self.members:
            corner = (nodes.index(self.target[agent]), nodes.index(agent))
            frame = Rectangle(corner, 1, 1, fill=False, edgecolor=drawing.INK)
            frame.set(linewidth=4, zorder=3)
            table.add_patch(frame)
        centres = np.arange(count) + 0.5
        names = list(map(name_of, nodes))
        table.set_xticks(centres, names)
        table.set_yticks(centres, names)
        table.set_ylim(count, 0)
        table.tick_params(
            top=True, labeltop=True, labelbottom=False, length=0, labelsize=14
        )
        table.spines[:].set_visible(False)
        for labels in (table.get_xticklabels(), table.get_yticklabels()):
            for agent, label in zip(nodes, labels, strict=True):
                label.set_color(self.colour(agent))

    def draw_graph(self, axes: Axes) -> None:
        """The reference rollout at the time of the risk, with the edges of the risk
        graph."""
        self.draw_map(axes, self.risky, trails=[])
        risks = np.tril(self.weights, -1)
        for pair in np.argwhere(risks >= self.settings.edge_threshold):
            axes.plot(
                *self.risky[pair, :2].T,
                color=drawing.INK,
                linewidth=1 + 4 * float(risks[tuple(pair)]),
                zorder=ON_TOP,
            )

    def draw_chain(self, axes: Axes) -> None:
        """The moment of the choice: who acts on whom, and how the coalition and the ego
        drove from there."""
        paths = self.rollout.states[self.step :, :, :2]
        valid = self.rollout.valid[self.step :]
        trails = [
            Trail(paths[valid[:, agent], agent], self.colour(agent), width=0.6)
            for agent in (*self.members, 0)
        ]
        self.draw_map(axes, self.chosen, trails=trails)
        head = {
            "arrowstyle": "-|>",
            "mutation_scale": 30,
            "color": drawing.INK,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        for agent in self.members:
            start = self.chosen[agent, :2]
            end = self.chosen[self.target[agent], :2]
            x, y = np.stack([start, end], 1)
            axes.plot(x, y, color=drawing.INK, linewidth=4, zorder=ON_TOP)
            tip = start + 0.8 * (end - start)
            axes.annotate("", tip, start, arrowprops=head, zorder=ON_TOP)

    def draw_map(self, axes: Axes, states: np.ndarray, trails: list[Trail]) -> None:
        """Vehicles at their states, with numbers beside the nodes; the coalition and
        the ego lie on top.

        Both maps show the square that holds the ego and the coalition at both times.
        """
        rollout = self.rollout
        drivers = [0, *self.members]
        points = np.concatenate([self.chosen[drivers, :2], self.risky[drivers, :2]])
        side = float(np.clip(np.ptp(points, axis=0).max() + MARGIN, SMALLEST, LARGEST))
        agents = np.flatnonzero(rollout.valid[self.step, : len(states)]).tolist()
        agents.sort(
            key=lambda agent: (self.colour(agent) != drawing.BACKGROUND, -agent)
        )
        shapes = []
        for agent in agents:
            colour = self.colour(agent)
            shapes += drawing.vehicle(states[agent], rollout.size[agent], colour)
        centre = (points.min(0) + points.max(0)) / 2
        TrafficMap(axes, rollout, metres=side).show(centre, trails, shapes)
        for agent in self.nodes():
            axes.annotate(
                name_of(agent),
                tuple(states[agent, :2]),
                (13, 9),
                textcoords="offset points",
                fontsize=15,
                color=drawing.INK,
                path_effects=[withStroke(linewidth=4, foreground=drawing.PANEL)],
                zorder=ON_TOP + 1,
                clip_on=True,
            )


def name_of(agent: int) -> str:
    return "ego" if agent == 0 else str(agent)
