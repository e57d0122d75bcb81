"""The messages: frozen, versioned, positional; one module for each kind of publisher.

On the wire a message is a MessagePack array `[tag, field, field, …]` in the order of its class;
`tag` is "name/version". A later version of the program may append fields (with defaults) without a
new version; readers ignore further fields. A new meaning, unit or frame is a new version. Arrays
travel as `bin`: little-endian, C order, of the type that `Floats`, `Ids` or `Stamps` names. SI
units, radians, bearings in (−π, π].

Every message has `stamp_ns`, its team time: the time of the measurement that it is about. `check`
raises `ValueError` with the reason where the numbers do not fit the message.
"""

from team.wire.messages.base import Bias as Bias
from team.wire.messages.base import Count as Count
from team.wire.messages.base import Digest as Digest
from team.wire.messages.base import Document as Document
from team.wire.messages.base import Message as Message
from team.wire.messages.base import Name as Name
from team.wire.messages.base import Real as Real
from team.wire.messages.base import StampNs as StampNs
from team.wire.messages.base import Text as Text
from team.wire.messages.base import check_counts as check_counts
from team.wire.messages.base import check_landmarks as check_landmarks
from team.wire.messages.base import tag_of as tag_of
from team.wire.messages.estimates import Disposition as Disposition
from team.wire.messages.estimates import Done as Done
from team.wire.messages.estimates import Innovation as Innovation
from team.wire.messages.estimates import MapEstimate as MapEstimate
from team.wire.messages.estimates import ParticleCloud as ParticleCloud
from team.wire.messages.estimates import PoseEstimate as PoseEstimate
from team.wire.messages.estimates import Rendezvous as Rendezvous
from team.wire.messages.maps import AssociationDecision as AssociationDecision
from team.wire.messages.maps import BiasEstimate as BiasEstimate
from team.wire.messages.maps import FusedMap as FusedMap
from team.wire.messages.maps import Membership as Membership
from team.wire.messages.maps import Prior as Prior
from team.wire.messages.maps import Trajectory as Trajectory
from team.wire.messages.maps import VersionEntry as VersionEntry
from team.wire.messages.measurements import AnyOdometry as AnyOdometry
from team.wire.messages.measurements import AnyScan as AnyScan
from team.wire.messages.measurements import Detections as Detections
from team.wire.messages.measurements import End as End
from team.wire.messages.measurements import Increment as Increment
from team.wire.messages.measurements import InitialPose as InitialPose
from team.wire.messages.measurements import Measurement as Measurement
from team.wire.messages.measurements import MeasurementsRequest as MeasurementsRequest
from team.wire.messages.measurements import Observations as Observations
from team.wire.messages.measurements import Odometry as Odometry
from team.wire.messages.measurements import Points as Points
from team.wire.messages.measurements import Sightings as Sightings
from team.wire.messages.measurements import Steering as Steering
from team.wire.messages.measurements import StreamEnd as StreamEnd
from team.wire.messages.measurements import StreamHead as StreamHead
from team.wire.messages.nodes import Configuration as Configuration
from team.wire.messages.nodes import Fault as Fault
from team.wire.messages.nodes import Kept as Kept
from team.wire.messages.nodes import KeptRequest as KeptRequest
from team.wire.messages.nodes import Liveliness as Liveliness
from team.wire.messages.nodes import Progress as Progress
from team.wire.messages.nodes import Status as Status
from team.wire.messages.nodes import Tally as Tally
from team.wire.messages.orders import GivenUp as GivenUp
from team.wire.messages.orders import Judgement as Judgement
from team.wire.messages.orders import LocalLandmark as LocalLandmark
from team.wire.messages.orders import TeamEnd as TeamEnd
from team.wire.messages.orders import Verdict as Verdict
from team.wire.messages.orders import Withdrawal as Withdrawal
from team.wire.messages.orders import WithdrawalHeard as WithdrawalHeard
from team.wire.messages.peers import Certificate as Certificate
from team.wire.messages.peers import Concluded as Concluded
from team.wire.messages.peers import FoldRequest as FoldRequest
from team.wire.messages.peers import Holding as Holding
from team.wire.messages.peers import Members as Members
from team.wire.messages.peers import MembersRequest as MembersRequest
from team.wire.messages.peers import Requested as Requested
from team.wire.messages.peers import SetSummary as SetSummary
from team.wire.messages.peers import Signature as Signature
from team.wire.messages.peers import Statements as Statements
from team.wire.messages.submaps import CLUTTER as CLUTTER
from team.wire.messages.submaps import UNCONFIRMED as UNCONFIRMED
from team.wire.messages.submaps import Association as Association
from team.wire.messages.submaps import SightingFactor as SightingFactor
from team.wire.messages.submaps import Submap as Submap
from team.wire.messages.submaps import SubmapsRequest as SubmapsRequest
from team.wire.messages.truth import NO_LABEL as NO_LABEL
from team.wire.messages.truth import KnownMap as KnownMap
from team.wire.messages.truth import RadioPlan as RadioPlan
from team.wire.messages.truth import Truth as Truth
from team.wire.messages.truth import TruthLabels as TruthLabels
from team.wire.messages.truth import TruthLandmarks as TruthLandmarks
from team.wire.messages.truth import TruthPositions as TruthPositions


def _by_tag(base: type[Message]) -> dict[str, type[Message]]:
    found: dict[str, type[Message]] = {}
    for message in base.__subclasses__():
        tag = message.__struct_config__.tag
        if isinstance(tag, str):
            found[tag] = message
        found |= _by_tag(message)
    return found


BY_TAG = _by_tag(Message)
"""Every message class by its tag."""
