"""A centre among peers: it has no estimator, and keeps and folds the team's set as they do.

It may join, leave and return at any time: no robot waits for it, and it requests missing members
from any peer. It publishes a centre's maps, which peers do not need.
"""

from collections.abc import Sequence

import msgspec

from teamslam.central.config import CentralConfig
from teamslam.central.peers.peer import CENTRE, Peer
from teamslam.team.peers.proofs import Proofs, Signs
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing


class PeerCentre(Peer):
    """The centre's peer: call `begin`, then `handle_sample` and `tick`, until `finished`."""

    def __init__(
        self, central: CentralConfig, robots: Sequence[str], signer: Signs | None = None
    ) -> None:
        proofs = None if signer is None else Proofs("", signer)
        super().__init__(CENTRE, central, robots, proofs=proofs)

    def begin(self) -> list[Outgoing]:
        """Make the first messages: the configuration, and the maps of earlier days."""
        return [*self.fold.centre.begin(), *self._maps]

    def _from_fold(self, messages: Sequence[Outgoing]) -> list[Outgoing]:
        """Select the fold's maps and orders; no robot needs this centre's credit."""
        return [each for each in messages if each.channel is not ch.CENTRAL_PROGRESS]

    def status(self) -> m.Status:
        """A centre's status with the figures of the set."""
        own = self.fold.centre.status()
        faults = (*self.boundary.warnings, *self.fold.boundary.warnings)
        figures = {**own.figures, **self.set_figures()}
        return msgspec.structs.replace(own, figures=figures, warnings=(*own.warnings, *faults))
