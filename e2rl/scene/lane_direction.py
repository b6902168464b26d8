"""Who drives against the lanes of a map."""

import torch
from torch import Tensor

LANE_REACH = 2.5  # m from a lane's centreline within which a vehicle is on it
ALONG = 0.5  # cosine between a heading and a lane above which a vehicle drives along it


def against_lanes(points: Tensor, lane: Tensor, xy: Tensor, heading: Tensor) -> Tensor:
    """Bool [B, K, H]: at xy [B, K, 2] a lane runs against vehicles of heading [B, K, H], and none runs with them.

    points [B, M, 2]: of centrelines; lane [B, M]: which one each point is of (-1: padding).
    """
    ahead = torch.nn.functional.normalize(points.diff(dim=1), dim=-1)
    same = (lane[:, 1:] == lane[:, :-1]) & (lane[:, 1:] >= 0)
    near = (torch.cdist(xy, points[:, :-1]) < LANE_REACH) & same[:, None]
    b, k, segment = near.nonzero(as_tuple=True)  # few of a map's segments are near
    towards = torch.stack([heading[b, k].cos(), heading[b, k].sin()], -1)
    cosine = (towards * ahead[b, segment][:, None]).sum(-1)

    def any_of(which: Tensor) -> Tensor:
        return torch.zeros_like(heading).index_put((b, k), which.to(heading.dtype), accumulate=True) > 0

    return any_of(cosine < -ALONG) & ~any_of(cosine > ALONG)
