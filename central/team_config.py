"""The configuration of a team: robots, centre, common settings."""

from typing import Annotated

import msgspec
from msgspec import Meta

from teamslam.central.config import CentralConfig
from teamslam.team.config import Estimator, Exchange, FusionRule, RobotConfig

KeyChunk = Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]{1,64}$")]
"""A part of a key, between two slashes."""


class TeamConfig(msgspec.Struct, frozen=True, kw_only=True):
    """A scenario without its world: every robot and the centre have the seed, estimator and rule.

    team: the chunk of the keys `team/<team>/…` that separates two teams on one network. exchange:
    with "rendezvous" a robot sends its submaps only when it observes a teammate or is observed.
    peers: every robot keeps and folds the team's set (docs/without_a_centre.md). centre: whether
    there is a central computer; else robots are peers. Fields of a world alone are ignored in
    decoding.
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
    """Decode the team of a resolved scenario in JSON; raises ValueError."""
    try:
        return msgspec.json.decode(text, type=TeamConfig)
    except (msgspec.MsgspecError, UnicodeEncodeError) as error:
        raise ValueError(f"not a team's configuration in JSON: {error}") from None
