"""The configuration of a team: robots, centre, common settings."""

from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.central.config import CentralConfig
from teamslam.team.config import Estimator, Exchange, FusionRule, RobotConfig

KeyChunk = Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]{1,64}$")]
"""A part of a key, between two slashes."""


class TeamConfig(msgspec.Struct, frozen=True, kw_only=True):
    """A scenario without its world: every robot and the centre have the seed, estimator and rule
    (docs/scenario.md).

    team: the chunk of the keys `team/<team>/…` that separates two teams. exchange: with
    "rendezvous" submaps are sent at encounters only. peers: every robot folds the team's set
    (docs/without_a_centre.md). Fields of a world are ignored in decoding.
    """

    name: KeyChunk
    team: KeyChunk
    robots: tuple[RobotConfig, ...]
    central: CentralConfig = CentralConfig()
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
    estimator: Estimator = "hybrid"
    fusion: FusionRule = "join"
    exchange: Exchange = "continuous"
    peers: bool = False
    centre: bool = True


def team_config(text: str) -> TeamConfig:
    """Decode a resolved scenario in JSON; raises ValueError."""
    try:
        return msgspec.json.decode(text, type=TeamConfig)
    except (msgspec.MsgspecError, UnicodeEncodeError) as error:
        raise ValueError(f"not a team's configuration in JSON: {error}") from None
