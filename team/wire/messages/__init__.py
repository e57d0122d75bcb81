"""The messages: frozen, versioned, positional; one module for each kind of publisher.

A message is a MessagePack array `[tag, field, field, …]`; `tag` is "name/version". A later program
may append fields with defaults; readers ignore further fields. A new meaning, unit or frame is a
new version. Arrays are `bin`: little-endian, C order, of the type `Floats`, `Ids` or `Stamps`. SI
units, radians, bearings in (−π, π].

`stamp_ns` is the team time of the measurement that the message is about. `check` raises
`ValueError` with the reason where the numbers do not fit the message.
"""

from teamslam.team.wire.messages.base import Author as Author
from teamslam.team.wire.messages.base import Bias as Bias
from teamslam.team.wire.messages.base import Count as Count
from teamslam.team.wire.messages.base import Digest as Digest
from teamslam.team.wire.messages.base import Document as Document
from teamslam.team.wire.messages.base import Message as Message
from teamslam.team.wire.messages.base import Name as Name
from teamslam.team.wire.messages.base import Real as Real
from teamslam.team.wire.messages.base import StampNs as StampNs
from teamslam.team.wire.messages.base import Text as Text
from teamslam.team.wire.messages.base import check_counts as check_counts
from teamslam.team.wire.messages.base import check_landmarks as check_landmarks
from teamslam.team.wire.messages.base import tag_of as tag_of
from teamslam.team.wire.messages.estimates import Disposition as Disposition
from teamslam.team.wire.messages.estimates import Done as Done
from teamslam.team.wire.messages.estimates import Innovation as Innovation
from teamslam.team.wire.messages.estimates import MapEstimate as MapEstimate
from teamslam.team.wire.messages.estimates import ParticleCloud as ParticleCloud
from teamslam.team.wire.messages.estimates import PoseEstimate as PoseEstimate
from teamslam.team.wire.messages.estimates import Rendezvous as Rendezvous
from teamslam.team.wire.messages.maps import MOST_OWN as MOST_OWN
from teamslam.team.wire.messages.maps import MOST_SAVED as MOST_SAVED
from teamslam.team.wire.messages.maps import AssociationDecision as AssociationDecision
from teamslam.team.wire.messages.maps import BiasEstimate as BiasEstimate
from teamslam.team.wire.messages.maps import Cause as Cause
from teamslam.team.wire.messages.maps import Diagnosis as Diagnosis
from teamslam.team.wire.messages.maps import FusedMap as FusedMap
from teamslam.team.wire.messages.maps import LandmarkChange as LandmarkChange
from teamslam.team.wire.messages.maps import Membership as Membership
from teamslam.team.wire.messages.maps import Prior as Prior
from teamslam.team.wire.messages.maps import RobotBias as RobotBias
from teamslam.team.wire.messages.maps import SavedMap as SavedMap
from teamslam.team.wire.messages.maps import Trajectory as Trajectory
from teamslam.team.wire.messages.maps import VersionEntry as VersionEntry
from teamslam.team.wire.messages.measurements import AnyOdometry as AnyOdometry
from teamslam.team.wire.messages.measurements import AnyScan as AnyScan
from teamslam.team.wire.messages.measurements import Detections as Detections
from teamslam.team.wire.messages.measurements import End as End
from teamslam.team.wire.messages.measurements import Fix as Fix
from teamslam.team.wire.messages.measurements import Increment as Increment
from teamslam.team.wire.messages.measurements import InitialPose as InitialPose
from teamslam.team.wire.messages.measurements import Measurement as Measurement
from teamslam.team.wire.messages.measurements import MeasurementsRequest as MeasurementsRequest
from teamslam.team.wire.messages.measurements import Observations as Observations
from teamslam.team.wire.messages.measurements import Odometry as Odometry
from teamslam.team.wire.messages.measurements import Points as Points
from teamslam.team.wire.messages.measurements import Sightings as Sightings
from teamslam.team.wire.messages.measurements import Steering as Steering
from teamslam.team.wire.messages.measurements import StreamEnd as StreamEnd
from teamslam.team.wire.messages.measurements import StreamHead as StreamHead
from teamslam.team.wire.messages.measurements import is_measurement as is_measurement
from teamslam.team.wire.messages.nodes import Configuration as Configuration
from teamslam.team.wire.messages.nodes import Fault as Fault
from teamslam.team.wire.messages.nodes import Kept as Kept
from teamslam.team.wire.messages.nodes import KeptRequest as KeptRequest
from teamslam.team.wire.messages.nodes import Liveliness as Liveliness
from teamslam.team.wire.messages.nodes import Progress as Progress
from teamslam.team.wire.messages.nodes import Status as Status
from teamslam.team.wire.messages.nodes import Tally as Tally
from teamslam.team.wire.messages.orders import GivenUp as GivenUp
from teamslam.team.wire.messages.orders import Judgement as Judgement
from teamslam.team.wire.messages.orders import LocalLandmark as LocalLandmark
from teamslam.team.wire.messages.orders import TeamEnd as TeamEnd
from teamslam.team.wire.messages.orders import Verdict as Verdict
from teamslam.team.wire.messages.orders import Withdrawal as Withdrawal
from teamslam.team.wire.messages.orders import WithdrawalHeard as WithdrawalHeard
from teamslam.team.wire.messages.peers import Certificate as Certificate
from teamslam.team.wire.messages.peers import Concluded as Concluded
from teamslam.team.wire.messages.peers import FoldRequest as FoldRequest
from teamslam.team.wire.messages.peers import Holding as Holding
from teamslam.team.wire.messages.peers import Members as Members
from teamslam.team.wire.messages.peers import MembersRequest as MembersRequest
from teamslam.team.wire.messages.peers import Requested as Requested
from teamslam.team.wire.messages.peers import SetSummary as SetSummary
from teamslam.team.wire.messages.peers import Signature as Signature
from teamslam.team.wire.messages.peers import Statements as Statements
from teamslam.team.wire.messages.submaps import CLUTTER as CLUTTER
from teamslam.team.wire.messages.submaps import UNCONFIRMED as UNCONFIRMED
from teamslam.team.wire.messages.submaps import Association as Association
from teamslam.team.wire.messages.submaps import SightingFactor as SightingFactor
from teamslam.team.wire.messages.submaps import Submap as Submap
from teamslam.team.wire.messages.submaps import SubmapsRequest as SubmapsRequest
from teamslam.team.wire.messages.truth import NO_LABEL as NO_LABEL
from teamslam.team.wire.messages.truth import KnownMap as KnownMap
from teamslam.team.wire.messages.truth import RadioPlan as RadioPlan
from teamslam.team.wire.messages.truth import Truth as Truth
from teamslam.team.wire.messages.truth import TruthLabels as TruthLabels
from teamslam.team.wire.messages.truth import TruthLandmarks as TruthLandmarks
from teamslam.team.wire.messages.truth import TruthPositions as TruthPositions


def _by_tag(base: type[Message]) -> dict[str, type[Message]]:
    found: dict[str, type[Message]] = {}
    for message in base.__subclasses__():
        tag = message.__struct_config__.tag
        if isinstance(tag, str):
            found[tag] = message
        found |= _by_tag(message)
    return found


BY_TAG = _by_tag(Message)
