"""Frames per second of the page, headless, with many robots and landmarks.

    python -m tests.trials.page [--robots 10] [--landmarks 1000] [--seconds 600] [--picture FILE]

Needs Chromium. Without a GPU the processor paints, so a machine with other work shows less.
"""

import argparse
import json
import tempfile
from pathlib import Path

from central.desk.view.server import session
from team.recording.recorder import Recorder
from tests.browser import browsing, chromium
from tests.crowd import crowd

PLAYS = """(async () => {
  const t = teamslam, speed = document.querySelector('#speed');
  speed.value = '%d'; speed.dispatchEvent(new Event('change'));
  t.seek(100); t.play(true);
  const frames = t.map.frames, began = performance.now();
  while (performance.now() - began < 4000) await new Promise(requestAnimationFrame);
  return (1000 * (t.map.frames - frames)) / (performance.now() - began);
})()"""
MOVES = """(async () => {
  const t = teamslam;
  t.seek(590);
  const frames = t.map.frames, began = performance.now();
  while (performance.now() - began < 4000) {
    t.map.centre = [t.map.centre[0] + 0.05, t.map.centre[1]];
    t.map.fitted = false;
    await new Promise(requestAnimationFrame);
  }
  return (1000 * (t.map.frames - frames)) / (performance.now() - began);
})()"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--landmarks", type=int, default=1000)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    program = chromium()
    if program is None:
        raise SystemExit("no Chromium on this machine")
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.mcap"
        with Recorder(log, "crowd", {}) as recorder:
            recorder.write(crowd(given.robots, given.landmarks, given.seconds))
        with session(log, "127.0.0.1", 0, 0, growing=False) as shown, browsing(program) as page:
            page.size(1440, 900)
            page.open(shown.url)
            page.wait("window.teamslam && teamslam.store.complete", 300.0)
            figures = {f"played at {speed} x [1/s]": page.ask(PLAYS % speed) for speed in (10, 100)}
            if given.picture is not None:
                page.picture(given.picture)
            figures["moved [1/s]"] = page.ask(MOVES)
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
