"""The skeleton figure: from risks to a chain, for one choice of a coalition that really ran (Sec. IV-A).

Three panels: the matrix of times to collision in the reference rollout, at the moment at which the coalition's own
links weigh most; the risk graph at that moment; the chain when it was chosen, and the ways that came of it.
"""

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from e2rl.evaluation.chains import link_risk
from e2rl.report import drawing
from e2rl.report.drawing import SUPERSAMPLING, RoadLayer, View
from e2rl.report.picture import shorten
from e2rl.synthesizer.selection import Selection
from e2rl.synthesizer.topology import TopologySettings

SIDE, GAP, HEAD, FOOT = 600, 12, 62, 34  # pixels: of a panel, between panels, above and below them
NODES = 10  # of the matrix at most
MARGIN, SMALLEST, LARGEST = 30.0, 60.0, 140.0  # m: round the coalition, and a panel's least and greatest side
CANDIDATE, FEASIBLE = drawing.VULNERABLE, "#2e8b57"
UNIT = SUPERSAMPLING


@dataclass
class SkeletonPicture:
    """A rollout as read from its file, the selection (B = 1) that happened in it, and the topology's settings."""

    rollout: dict
    selection: Selection
    settings: TopologySettings

    def __post_init__(self):
        chosen = self.selection
        self.coalition, self.candidates, self.feasible = (
            value[0].cpu().numpy() for value in (chosen.coalition, chosen.candidates, chosen.feasible)
        )
        self.target, self.step = chosen.target[0].tolist(), int(chosen.step)
        everything = chosen.weights[0].sum((1, 2))
        moment = int((link_risk(chosen)[0] + 1e-6 * everything).argmax())
        self.time = float(chosen.moments[0, moment])
        self.weights = chosen.weights[0, moment].cpu().numpy()
        self.risky = chosen.reference[0, moment].cpu().numpy()
        self.now = self.rollout["states"][self.step]
        self.view = self.square()
        self.road = RoadLayer(self.rollout, np.array([self.view.centre]), self.view.metres, SIDE)

    def nodes(self) -> list[int]:
        """Vehicles of the matrix: the ego, the coalition, then whoever's edges weigh most."""
        own = [0, *np.flatnonzero(self.coalition).tolist()]
        edges = self.weights * (self.weights >= self.settings.edge_threshold)
        others = [i for i in np.argsort(-edges.sum(1), kind="stable").tolist() if edges[i].any() and i not in own]
        return own + sorted(others[: max(NODES - len(own), 0)])

    def square(self) -> View:
        """The window of both maps: the ego and the coalition, now and at the moment of risk."""
        own = self.coalition.copy()
        own[0] = True
        points = np.concatenate([states[: len(own)][own, :2] for states in (self.now, self.risky)])
        side = float(np.clip(np.ptp(points, axis=0).max() + MARGIN, SMALLEST, LARGEST))
        return View(tuple((points.min(0) + points.max(0)) / 2), side, SIDE)

    def colour(self, agent: int) -> str:
        if agent == 0:
            return drawing.EGO
        for mask, colour in (
            (self.coalition, drawing.ADVERSARY),
            (self.candidates, CANDIDATE),
            (self.feasible, FEASIBLE),
        ):
            if agent < len(mask) and mask[agent]:
                return colour
        return drawing.BACKGROUND

    def figure(self) -> Image.Image:
        """The three panels beside each other under their titles."""
        width = 3 * SIDE + 2 * GAP
        figure = Image.new("RGB", (UNIT * width, UNIT * (SIDE + HEAD + FOOT)), drawing.PANEL)
        draw, rollout = ImageDraw.Draw(figure), self.rollout
        title = (
            f"{shorten(rollout['scene_id'])}   seed {rollout['seed']}   intensity {rollout['eta']:g}   "
            f"{rollout['method']} vs {rollout['ego_policy']}   chosen at {self.step * rollout['dt']:.1f} s"
        )
        draw.text((8 * UNIT, 5 * UNIT), title, font=drawing.font(16), fill=drawing.INK)
        within = f"{self.settings.clearance:g} m"
        panels = (
            (f"s until boxes are within {within}, {self.time:.1f} s into the reference rollout", self.matrix()),
            (f"risk graph then, edges of TTC < {self.ttc(self.settings.edge_threshold):.1f} s", self.graph()),
            ("active chain, and the ways that came of it", self.chain()),
        )
        for index, (caption, panel) in enumerate(panels):
            left = index * (SIDE + GAP) * UNIT
            draw.text((left + 8 * UNIT, 35 * UNIT), caption, font=drawing.font(15), fill=drawing.MUTED)
            figure.paste(panel, (left, HEAD * UNIT))
        self.legend(draw, (HEAD + SIDE + FOOT / 2) * UNIT)
        return figure.reduce(UNIT)

    def ttc(self, weight: float) -> float:
        """Seconds [s] of a pair of this weight, eq. (ttc_weight) inverted."""
        return max(0.0, self.settings.tau_max - self.settings.beta * math.log(weight / (1 - weight)))

    def matrix(self) -> Image.Image:
        """TTC of every pair of nodes, red by weight; the coalition's links are framed."""
        nodes, side = self.nodes(), SIDE * UNIT
        image = Image.new("RGB", (side, side), drawing.PANEL)
        draw, edge = ImageDraw.Draw(image), 52 * UNIT
        cell = (side - edge - 8 * UNIT) / len(nodes)
        face = drawing.font(min(17, 0.33 * cell / UNIT))
        for row, i in enumerate(nodes):
            middle = edge + (row + 0.5) * cell
            for at in ((edge / 2, middle), (middle, edge / 2)):
                draw.text(at, name(i), font=drawing.font(15), fill=self.colour(i), anchor="mm")
            for column, j in enumerate(nodes):
                weight = float(self.weights[i, j])
                box = (edge + column * cell, edge + row * cell, edge + (column + 1) * cell, edge + (row + 1) * cell)
                ground = drawing.blend(drawing.CONTACT, drawing.GROUND, weight) if i != j else drawing.BACKGROUND
                draw.rectangle(box, fill=ground, outline=drawing.PANEL, width=UNIT)
                if i != j and weight > 0:
                    ink = drawing.PANEL if weight > 0.6 else drawing.INK
                    draw.text(
                        ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2),
                        f"{self.ttc(weight):.1f}",
                        font=face,
                        fill=ink,
                        anchor="mm",
                    )
        for row, i in enumerate(nodes):
            for column, j in enumerate(nodes):
                if i and self.coalition[i] and self.target[i] == j:
                    box = (edge + column * cell, edge + row * cell, edge + (column + 1) * cell, edge + (row + 1) * cell)
                    draw.rectangle(box, outline=drawing.INK, width=4 * UNIT)
        return image

    def graph(self) -> Image.Image:
        """The reference rollout at the moment of risk, with the edges of the risk graph."""
        image = self.road.window(self.view)
        draw, count = ImageDraw.Draw(image), len(self.weights)
        places = self.view.place(self.risky[:, :2])
        self.vehicles(draw, self.risky)
        for i in range(count):
            for j in range(i):
                weight = float(self.weights[i, j])
                if weight >= self.settings.edge_threshold:
                    line = [tuple(places[i]), tuple(places[j])]
                    draw.line(line, fill=drawing.INK, width=round((1.5 + 5 * weight) * UNIT))
        self.names(draw, self.risky)
        return image

    def chain(self) -> Image.Image:
        """The moment of the choice: who acts on whom, and how the ego and the coalition drove from there."""
        image = self.road.window(self.view)
        draw, places = ImageDraw.Draw(image), self.view.place(self.now[:, :2])
        for agent in [*np.flatnonzero(self.coalition).tolist(), 0]:
            path = self.rollout["states"][self.step :, agent, :2][self.rollout["valid"][self.step :, agent]]
            drawing.draw_trail(draw, self.view, path, self.colour(agent), 0.6)
        self.vehicles(draw, self.now)
        for agent in np.flatnonzero(self.coalition).tolist():
            arrow(draw, places[agent], places[self.target[agent]])
        self.names(draw, self.now)
        return image

    def vehicles(self, draw: ImageDraw.ImageDraw, states: np.ndarray) -> None:
        """Everybody who is there when the coalition is chosen; the coalition and the ego on top."""
        shown = [agent for agent in range(len(states)) if self.rollout["valid"][self.step, agent]]
        for agent in sorted(shown, key=lambda agent: (self.colour(agent) != drawing.BACKGROUND, -agent)):
            drawing.draw_vehicle(draw, self.view, states[agent], self.rollout["size"][agent], self.colour(agent))

    def names(self, draw: ImageDraw.ImageDraw, states: np.ndarray) -> None:
        """Numbers beside the vehicles of the matrix."""
        for agent in self.nodes():
            x, y = self.view.place(states[agent, :2])
            draw.text(
                (x + 17 * UNIT, y - 17 * UNIT),
                name(agent),
                font=drawing.font(16),
                fill=drawing.INK,
                anchor="mm",
                stroke_width=2 * UNIT,
                stroke_fill=drawing.PANEL,
            )

    def legend(self, draw: ImageDraw.ImageDraw, middle: float) -> None:
        entries = (
            ("ego", drawing.EGO),
            ("coalition C*", drawing.ADVERSARY),
            ("candidate of the topology", CANDIDATE),
            ("feasible, no candidate", FEASIBLE),
            ("others", drawing.BACKGROUND),
        )
        x = 8 * UNIT
        for text, colour in entries:
            box = (x, middle - 7 * UNIT, x + 20 * UNIT, middle + 7 * UNIT)
            draw.rounded_rectangle(box, radius=3 * UNIT, fill=colour)
            draw.text((x + 27 * UNIT, middle), text, font=drawing.font(14), fill=drawing.INK, anchor="lm")
            x += 50 * UNIT + draw.textlength(text, font=drawing.font(14))


def skeleton_figure(rollout: dict, selection: Selection, settings: TopologySettings) -> Image.Image:
    """The figure of a selection (B = 1) and of the rollout that it belongs to."""
    return SkeletonPicture(rollout, selection, settings).figure()


def name(agent: int) -> str:
    return "ego" if agent == 0 else str(agent)


def arrow(draw: ImageDraw.ImageDraw, start: np.ndarray, end: np.ndarray) -> None:
    """From one drawn place towards another, its head at three quarters of the way."""
    ahead = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    left = np.array([-ahead[1], ahead[0]])
    tip = start + 0.75 * (end - start)
    draw.line([tuple(start), tuple(end)], fill=drawing.INK, width=4 * UNIT)
    draw.polygon(
        [tuple(tip + 14 * UNIT * ahead), tuple(tip + 9 * UNIT * left), tuple(tip - 9 * UNIT * left)], fill=drawing.INK
    )
