import json
import subprocess

from teamslam.central.desk.verification.verification import verify
from teamslam.team.recording.reader import open_log
from tests.system.processes import PROGRAM
from tests.system.scenarios import map_in_memory, sha256, short


def test_without_a_centre_every_robots_final_map_is_that_of_a_central_run(tmp_path):
    scenario = short(tmp_path, steps=40)
    done = subprocess.run(
        [*PROGRAM, "launch", str(scenario), "--without-centre", "--no-report", "--no-views",
         "--output", str(tmp_path / "run"), "--json", str(tmp_path / "result.json")],
        capture_output=True, text=True, timeout=200, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "result.json").read_text())
    assert "central" not in result["processes"]
    expected = sha256(map_in_memory(scenario))
    assert result["final_map_sha256"] == expected
    peers = result["peers"]
    assert {name: peer["final_map_sha256"] for name, peer in peers.items()} == dict.fromkeys(
        ["r1", "r2"], expected
    )
    assert all(peer["uplink_bytes"] and peer["downlink_bytes"] for peer in peers.values())
    log = verify(open_log(tmp_path / "run" / "log.mcap"))
    assert log.first is None
    assert {"team_map", "team_final"} <= {channel.channel for channel in log.channels}
