"""What processes say of themselves: configuration, progress, status, faults, life."""

from typing import Annotated

from msgspec import Meta

from team.wire.messages.base import Count, Digest, Document, Message, Name, Real, StampNs, Text


class Configuration(Message, frozen=True, kw_only=True, tag="configured/1"):
    """A node's configuration (JSON), announced once; `digest` is its 8-byte name elsewhere."""

    node: Text
    incarnation: Count
    digest: Digest
    configuration: Document


class Progress(Message, frozen=True, kw_only=True, tag="progress/1"):
    """How far a node is: per (robot, incarnation) the count of measurements it is done with, and of
    submaps.

    A robot reports itself: measurements consumed (while it waits for an exchange of maps:
    received), and stamp_ns is the team time before which it sends no submap any more. The centre
    reports submaps that are in its set; the recorder reports measurements that it has taken.
    """

    node: Text
    robot: Name
    incarnation: Count
    measurements: Count
    submaps: Count


class Status(Message, frozen=True, kw_only=True, tag="status/1"):
    """What a node is doing, for people: a state word, figures by name, warnings in words."""

    node: Text
    state: Text
    figures: dict[str, Real]
    warnings: tuple[Text, ...] = ()


class Fault(Message, frozen=True, kw_only=True, tag="fault/1"):
    """A node could not handle a message and set it aside; stamp_ns is the message's.

    origin: its key, the query's for a reply, the duty's name if there was no message. count: its
    publisher's count of the key; -1: none. message: its tag; empty where it raised before it was
    one. error, text: the exception's class and words. place: module:function:line. digest: 8 bytes,
    the payload's BLAKE2b.
    """

    node: Text
    origin: Text
    count: Annotated[int, Meta(ge=-1, le=2**63 - 1)]
    message: Text
    error: Text
    text: Text
    place: Text
    digest: Digest


class Liveliness(Message, frozen=True, kw_only=True, tag="liveliness/1"):
    """A node's liveliness token appeared or went; a recorded input of whoever reacted to it."""

    node: Text
    alive: bool


class Tally(Message, frozen=True, kw_only=True, tag="tally/1"):
    """What a process has published of each key, said at its end: what is not in a log is missing.

    since_ns: its wall clock at the beginning [ns since 1970]; what it published is not older.
    """

    node: Text
    since_ns: StampNs
    keys: tuple[Text, ...]
    counts: tuple[Count, ...]

    def check(self) -> None:  # noqa: D102
        if len(self.keys) != len(self.counts):
            raise ValueError(f"{len(self.counts)} counts of {len(self.keys)} keys")


class KeptRequest(Message, frozen=True, kw_only=True, tag="kept_wanted/1"):
    """A query to the router for samples that it stores, newest last.

    channels: the names of the channels that are wanted. node: the node that asks. run_ns: how long
    ago its run began; of the messages that end a team only those are sent that are younger, or that
    a process of this node missed: it was in that run and left without a `Tally`.
    """

    channels: tuple[Text, ...]
    node: Text = ""
    run_ns: Count = 0


class Kept(Message, frozen=True, kw_only=True, tag="kept/1"):
    """A sample that the router stores, as its author published it: key, payload, and attachment.

    stamp_ns: the sample's team time, wall_ns: its author's wall clock, counter: its author's.
    """

    key: Text
    payload: bytes
    wall_ns: StampNs
    counter: Count
