import pytest

from teamslam.team.wire import channels as c
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import WireError, encoded
from tests.support import odometry, submap


def sample(key: str, message: m.Message) -> Sample:
    return Sample(key, encoded(message), message.stamp_ns, 0, 0)


@pytest.mark.parametrize("channel", c.CHANNELS, ids=lambda channel: channel.name)
def test_every_key_leads_back_to_its_channel_and_name(channel):
    name = (
        "robot/alpha"
        if "{node}" in channel.template
        else "alpha"
        if "{robot}" in channel.template
        else ""
    )
    if channel in c.UNOPENED:
        assert c.channel_of(channel.key(name)) is None
    else:
        assert c.channel_of(channel.key(name)) == (channel, name)


def test_no_two_channels_share_a_name_or_a_key():
    assert len({channel.name for channel in c.CHANNELS}) == len(c.CHANNELS)
    assert len({channel.template for channel in c.CHANNELS}) == len(c.CHANNELS)


def test_a_key_that_no_channel_has_is_refused():
    with pytest.raises(WireError, match="no channel has the key 'robot/alpha/gossip'"):
        opened(sample("robot/alpha/gossip", submap(0)))


def test_a_robots_message_on_another_robots_key_is_refused():
    with pytest.raises(WireError, match="a message of 'alpha' on the key 'robot/bravo/submap'"):
        opened(sample("robot/bravo/submap", submap(0, "alpha")))


def test_a_message_on_another_channels_key_is_refused():
    with pytest.raises(WireError, match="wrong tag: 'odometry/1' where 'submap/1' belongs"):
        opened(sample("robot/alpha/submap", odometry(0)))
