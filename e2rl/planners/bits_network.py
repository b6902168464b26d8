"""The networks of the ego `bits`: scene encoder, goal head and goal-conditioned policy,
and their file.

Goals beside a mission: a grid of the places that a vehicle may have reached at the end
of its plan.

A goal is a distance [m] along the mission from the vehicle's present place and a side
[m] beside the mission (left positive). The grid covers the distances up to `reach`, in
cells whose length grows with the vehicle's speed.
"""

import json
import math
from collections.abc import Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from e2rl.planners.candidates import Candidates, drive
from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.path import RoutePath
from e2rl.planners.trunk import Normaliser, linear
from e2rl.run.errors import InputError
from e2rl.run.files import check_format, write_atomically
from e2rl.run.weights import read_weights, unlike, weight_bytes
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.observation import OBSERVATION_SIZE

PLAN_SECONDS = PLAN_STEPS * DT  # s
DISTANCES = 32  # cells along the mission
SIDES = 7  # cells beside it
CELLS = DISTANCES * SIDES  # G: cell w * SIDES + s
SIDE = 1.0  # m, width of a cell
FASTEST = 2.5  # m/s^2: acceleration over the horizon that leads to the grid's end
FORMAT = "e2rl-bits/1"
WEIGHTS = "bits.safetensors"  # file name in a run's folder
LARGEST = 1 << 12  # units of a layer
KNOTS = 10  # accelerations of a plan, each held PLAN_STEPS / KNOTS steps
GOAL_FEATURES = 6
ACCELERATION = (-8.0, 5.0)  # m/s^2, the simulator's bounds
TIME = (0.5, 4.0)  # s that a lateral move takes (`candidates.drive`)
START_TIME = 1.4  # s that it takes before training
AROUND = SIDE  # m: the move leads at most so far beside the goal


def reach(speed: Tensor) -> Tensor:
    """Distances [...] m to the end of the grid from speeds [...] m/s."""
    return PLAN_SECONDS * speed + FASTEST * PLAN_SECONDS**2 / 2


def place(
    speed: Tensor,
    cell: Tensor,
    residual: Tensor,
) -> tuple[Tensor, Tensor]:
    """Distances and sides [B, K] m of the goals at `cell` [B, K] with residual [B, K,
    2], in cells from the cell's centre; speed [B] m/s. No distance is negative."""
    along = cell.div(SIDES, rounding_mode="floor") + 0.5 + residual[..., 0]
    across = cell % SIDES - (SIDES - 1) / 2 + residual[..., 1]
    return (along * reach(speed)[:, None] / DISTANCES).clamp(min=0), across * SIDE


def cell_of(
    speed: Tensor,
    distance: Tensor,
    side: Tensor,
) -> tuple[Tensor, Tensor]:
    """The cells [W] of goals distance, side [W] m, and their residuals [W, 2]: the
    inverse of `place`. A goal off the grid counts to the nearest cell."""
    along = distance / reach(speed) * DISTANCES - 0.5
    across = side / SIDE + (SIDES - 1) / 2
    row = along.round().clamp(0, DISTANCES - 1)
    column = across.round().clamp(0, SIDES - 1)
    residual = torch.stack([along - row, across - column], -1)
    return (row * SIDES + column).long(), residual


def needed_acceleration(speed: Tensor, distance: Tensor) -> Tensor:
    """The constant acceleration [...] m/s^2 that drives `distance` [...] m within the
    horizon from speed [...] m/s: to its end, or to a halt before it."""
    going = 2 * (distance - PLAN_SECONDS * speed) / PLAN_SECONDS**2
    halting = -speed.square() / (2 * distance.clamp(min=0.1))
    return torch.where(distance < PLAN_SECONDS * speed / 2, halting, going)


class Controls(NamedTuple):
    """What the policy decides of K plans in each of B scenes: acceleration [B, K,
    KNOTS] m/s^2, shift [B, K] m beside the mission where the plan leads, over time [B,
    K] s."""

    acceleration: Tensor
    shift: Tensor
    time: Tensor


class BitsNetwork(nn.Module):
    """Observation -> code; code -> distribution over goals; code and goal -> controls
    of a plan.

    Outputs start at zero: untrained, all goals are equally likely and every plan keeps
    its speed. dropout: fraction of a code's numbers that are left out in training mode.
    """

    def __init__(self, hidden: int = 64, dropout: float = 0.0) -> None:
        super().__init__()
        self.architecture = {
            "observation": OBSERVATION_SIZE,
            "hidden": int(hidden),
            "cells": CELLS,
            "knots": KNOTS,
        }
        self.normaliser = Normaliser(OBSERVATION_SIZE)
        layers = perceptron([OBSERVATION_SIZE, 2 * hidden, hidden], last_gain=2**0.5)
        self.encoder = nn.Sequential(layers, nn.SiLU(), nn.Dropout(dropout))
        self.goal_head = perceptron([hidden, hidden, 3 * CELLS], last_gain=0.0)
        inputs = hidden + GOAL_FEATURES
        self.policy = perceptron(
            [
                inputs,
                hidden,
                hidden,
                KNOTS + 2,
            ],
            last_gain=0.0,
        )

    def encode(self, observation: Tensor, noise: Tensor | None = None) -> Tensor:
        """Codes [B, hidden] of observations [B, D]; noise [B, D] is added to the
        normalised ones, in training."""
        normalised = self.normaliser(observation)
        return self.encoder(normalised if noise is None else normalised + noise)

    def goals(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """Of every goal's cell the logit [B, CELLS], and the place in it: residual [B,
        CELLS, 2] in cells."""
        logits, residual = self.goal_head(code).split([CELLS, 2 * CELLS], -1)
        return logits, residual.unflatten(-1, (CELLS, 2))

    def controls(
        self,
        code: Tensor,
        *,
        speed: Tensor,
        offset: Tensor,
        distance: Tensor,
        side: Tensor,
    ) -> Controls:
        """Returns the policy's Controls of plans to K goals.

        Args:
            code: [B, hidden], of `encode`.
            speed: [B] m/s.
            offset: [B] m beside the mission.
            distance: [B, K] m along the mission to the goals.
            side: [B, K] m of the goals beside it.
        """
        speed = speed[:, None].expand_as(distance)
        features = [
            distance / reach(speed),
            distance / 50,
            needed_acceleration(speed, distance) / 4,
            side / 3,
            (side - offset[:, None]) / 3,
            speed / 15,
        ]
        code = code[:, None].expand(-1, distance.shape[1], -1)
        out = self.policy(torch.cat([code, torch.stack(features, -1)], -1))
        return Controls(
            between(
                out[..., :KNOTS],
                ACCELERATION,
                start=0.0,
            ),
            side + AROUND * out[..., KNOTS].tanh(),
            time=between(
                out[..., -1],
                TIME,
                start=START_TIME,
            ),
        )

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.normaliser.mean.device


def perceptron(sizes: Sequence[int], last_gain: float) -> nn.Sequential:
    """Layers of these sizes with SiLU between; orthogonal weights, the last layer's
    scaled by last_gain."""
    layers = nn.Sequential()
    for fan_in, fan_out in zip(
        sizes[:-2],
        sizes[1:-1],
        strict=True,
    ):
        layers.extend([linear(fan_in, fan_out, gain=2**0.5), nn.SiLU()])
    return layers.append(
        linear(
            sizes[-2],
            sizes[-1],
            gain=last_gain,
        )
    )


def between(
    value: Tensor,
    bounds: tuple[float, float],
    start: float,
) -> Tensor:
    """Values squashed into the bounds by a sigmoid; 0 becomes `start`."""
    low, high = bounds
    fraction = (start - low) / (high - low)
    return low + (high - low) * (value + math.log(fraction / (1 - fraction))).sigmoid()


def drive_controls(
    controls: Controls,
    start: Tensor,
    path: RoutePath,
) -> Candidates:
    """The Candidates [B, K] that Controls make of states start [B, 4] on their paths,
    by the unicycle."""
    held = controls.acceleration.repeat_interleave(PLAN_STEPS // KNOTS, -1)
    first = start[:, None, 3:].expand(*held.shape[:2], 1)
    speed = torch.cat([first, dynamics.bounded_speed(first, held * DT)], -1)
    return drive(
        start,
        path,
        speed=speed,
        shift=controls.shift[..., None],
        time=controls.time[..., None],
    )


def save_bits(
    network: BitsNetwork,
    path: Path,
    origin: dict[str, Any],
) -> None:
    """Write a network to a safetensors file; origin: what made it (data, command,
    settings), kept in the header."""
    header = {
        "format": FORMAT,
        "architecture": json.dumps(network.architecture),
        "origin": json.dumps(origin),
    }
    write_atomically(path, weight_bytes(network.state_dict(), header))


def load_bits(checkpoint: str) -> BitsNetwork:
    """The network in a file of `save_bits`, in a folder with one, or with "bundled" the
    package's own, trained on the bundled scenes. Raises InputError, naming the file,
    where it is missing, damaged or of another architecture."""
    path = Path(checkpoint)
    if checkpoint == "bundled":
        path = Path(str(files("e2rl") / "assets" / "bits"))
    path = path / WEIGHTS if path.is_dir() else path
    if not path.is_file():
        raise InputError(
            f"ego.checkpoint={checkpoint}: no {WEIGHTS} there; train one with `python "
            "train.py stage=bits`, or use ego.checkpoint=bundled"
        )
    try:
        weights, header = read_weights(path)
        mend = "train one by `python train.py stage=bits`"
        check_format(path, header.get("format"), expected=FORMAT, mend=mend)
        saved = json.loads(header["architecture"])
        hidden = saved["hidden"]
        if type(hidden) is not int or not 0 < hidden <= LARGEST:
            raise ValueError(f"{hidden} hidden units")
        if wrong := unlike(partial(BitsNetwork, hidden), weights):
            raise ValueError(wrong)
        network = BitsNetwork(hidden)
        if saved != network.architecture:
            raise ValueError(f"{saved} instead of {network.architecture}")
        network.load_state_dict(weights)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split("\n\t")[:2])
        raise InputError(
            f"{path}: damaged, or of another architecture ({reason}); train it again"
        ) from error
    return network.requires_grad_(False).eval()
