"""A fusion rule by the recipe of docs/architecture.md: one node in one file."""

import math

import numpy as np

from teamslam.central.fused_map import fused_message, version_entry
from teamslam.central.join_messages import Tail
from teamslam.central.node import CentralNode
from teamslam.central.submap_fold import RecordedFields, SubmapFold
from teamslam.team import translate
from teamslam.team.estimation.gaussian import LandmarkGaussian
from teamslam.team.estimation.se2 import transformed
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import digest_of


class FirstSubmaps(SubmapFold):
    """Landmarks of each robot's first submap at its initial pose; of two, the first robot's."""

    def fold_until(self, closed_ns: float) -> None:
        """Do nothing before a map is made."""

    def make_map(
        self,
        tail: Tail,
        closed_ns: float = math.inf,
        *,
        ahead: bool = True,
        recorded: RecordedFields | None = None,
    ) -> list[Outgoing]:
        """A function of the set alone."""
        landmarks: dict[int, np.ndarray] = {}
        heard = dict(sorted(self.store.chains.items()))
        for stream, chain in heard.items():
            start = translate.start_of(self.store.start(stream))
            local = translate.local_map_of(chain[0])
            if start is not None:
                for id_, mean in zip(local.ids.tolist(), local.landmarks, strict=True):
                    landmarks.setdefault(id_, transformed(start.pose, mean))
        ids = sorted(landmarks)
        means = np.array([landmarks[id_] for id_ in ids]).reshape(-1, 2)
        value = LandmarkGaussian(np.array(ids, np.uint32), means, np.eye(means.size))
        named = (encoded(chain[0]) for chain in heard.values())
        fused = fused_message(
            self.config,
            digest_of(self.config_digest, tail.encode(), *named),
            value,
            tuple(version_entry(stream, len(chain) - 1) for stream, chain in heard.items()),
            stamp_ns=max((chain[-1].stamp_ns for chain in heard.values()), default=0),
            final=tail == "final",
        )
        self.landmarks = len(ids)
        return [Outgoing(ch.FINAL_MAP if tail == "final" else ch.FUSED_MAP, "", fused)]


class FirstSubmapsCentre(CentralNode):
    fold_class = FirstSubmaps
