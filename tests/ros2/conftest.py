import socket

import pytest
import zenoh

Network = tuple[zenoh.Session, str]  # the router's session and its endpoint


@pytest.fixture
def network():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")
    with zenoh.open(config) as router:
        yield router, endpoint
