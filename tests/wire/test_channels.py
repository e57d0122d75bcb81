import pytest

from teamslam.team.wire import channels as c
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import WireError, encoded
from tests.support import odometry, submap


@pytest.mark.parametrize("channel", c.CHANNELS, ids=lambda channel: channel.name)
def test_every_key_leads_back_to_its_channel_and_name(channel):
    names = {"{node}": "robot/alpha", "{robot}": "alpha"}
    name = next((name for place, name in names.items() if place in channel.template), "")
    expected = None if channel in c.UNOPENED else (channel, name)
    assert c.channel_of(channel.key(name)) == expected


def test_no_two_channels_share_a_name_or_a_key():
    assert len({channel.name for channel in c.CHANNELS}) == len(c.CHANNELS)
    assert len({channel.template for channel in c.CHANNELS}) == len(c.CHANNELS)


@pytest.mark.parametrize(
    ("key", "message", "why"),
    [
        ("robot/alpha/gossip", submap(0), "no channel has the key 'robot/alpha/gossip'"),
        ("robot/bravo/submap", submap(0), "a message of 'alpha' on the key 'robot/bravo/submap'"),
        ("robot/alpha/submap", odometry(0), "wrong tag: 'odometry/1' where 'submap/1' belongs"),
    ],
)
def test_a_message_on_a_key_that_is_not_its_own_is_refused(key, message, why):
    with pytest.raises(WireError, match=why):
        opened(Sample(key, encoded(message), message.stamp_ns, 0, 0))
