import asyncio
import json
import re
import signal
from xml.etree import ElementTree

import msgspec
import pytest

from teamslam.central.desk.view.server import session
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import floats, from_floats
from teamslam.team.wire.bus import opened
from teamslam.team.wire.codec import encoded
from tests.browser import Page, browsing, chromium
from tests.crowd import crowd
from tests.support import wait_until
from tests.system.processes import until
from tests.system.scenarios import short

PROGRAM = chromium()
pytestmark = pytest.mark.skipif(
    PROGRAM is None, reason="no Chromium on this machine (Debian: apt install chromium)"
)
ROBOTS, LANDMARKS, SECONDS = 3, 40, 60
MOVED_FRAME = (30.0, -10.0)
READY = "window.teamslam !== undefined && teamslam.store.complete && teamslam.map.frames > 0"


@pytest.fixture(scope="module")
def browser():
    with browsing(PROGRAM or "") as page:
        yield page


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "log.mcap"
    with Recorder(path, "crowd", {}) as recorder:
        recorder.write(crowd(ROBOTS, LANDMARKS, SECONDS))
    with session(path, "127.0.0.1", 0, 0, growing=False) as shown:
        yield shown.url


def open_page(browser, url):
    browser.errors.clear()
    browser.size(1280, 800)
    browser.open(url)
    browser.wait(READY)


@pytest.fixture
def page(browser, url):
    open_page(browser, url)
    # The badge is written with all tables, after the last message.
    browser.wait("document.querySelector('#badge').textContent === 'LOG'")
    browser.wait(f"document.querySelector('#landmarks').textContent === '{LANDMARKS}'")
    return browser


def now(page: Page) -> float:
    return float(page.text("#now"))


def place_of(page: Page, robot: str) -> tuple[float, float]:
    cells = [page.text(f"[data-robot={robot}] td:nth-child({k})") for k in (2, 3)]
    return (float(cells[0]), float(cells[1]))


def seek(page: Page, time: float) -> None:
    # Replacing one table rewrites all.
    page.ask(f"document.querySelector('#end').textContent = ''; teamslam.seek({time})")
    page.wait(f"document.querySelector('#now').textContent === '{time:.1f}'")
    page.wait("document.querySelector('#end').textContent !== ''")


def test_a_log_is_shown_with_its_last_map_and_where_every_robot_is(page):
    assert now(page) == pytest.approx(SECONDS, abs=0.5)
    assert page.text("#badge") == "LOG"
    assert page.text("#robot-count") == str(ROBOTS)
    true = page.ask("[...teamslam.store.robots.get('r2').truth.rows.slice(-3)]")
    x, y = place_of(page, "r2")
    assert abs(x - true[0]) < 1.5
    assert abs(y - true[1]) < 1.5
    assert page.errors == []


def test_the_slider_goes_back_in_time_to_a_smaller_map_and_other_places(page):
    late = place_of(page, "r1")
    box = page.ask("(() => { const b = document.querySelector('#slider').getBoundingClientRect();"
                   "return [b.left, b.right, b.top + b.height / 2]; })()")  # fmt: skip
    left, right, y = box
    page.drag((right - 9, y), (left + (right - left) / 2, y))
    page.wait("Number(document.querySelector('#now').textContent) < 40")
    page.wait(f"Number(document.querySelector('#landmarks').textContent) < {LANDMARKS}")
    assert 20.0 < now(page) < 40.0
    assert int(page.text("#landmarks")) >= 1
    wait_until(lambda: place_of(page, "r1") != late, what="another place of r1")


def test_it_plays_and_pauses_and_ends_at_the_end(page):
    seek(page, 10)
    page.ask("document.querySelector('#speed').value = '5'; "
             "document.querySelector('#speed').dispatchEvent(new Event('change'))")  # fmt: skip
    page.click("#play")
    page.wait("Number(document.querySelector('#now').textContent) > 15")
    page.click("#play")
    page.wait("!teamslam.state.playing")
    page.wait("document.querySelector('#now').textContent === teamslam.state.time.toFixed(1)")
    paused = now(page)
    page.ask("new Promise((done) => setTimeout(done, 300))")
    assert now(page) == paused
    page.ask("document.querySelector('#speed').value = '100'; "
             "document.querySelector('#speed').dispatchEvent(new Event('change'))")  # fmt: skip
    page.click("#play")
    page.wait(f"Number(document.querySelector('#now').textContent) >= {SECONDS - 0.1}")
    page.wait("!teamslam.state.playing")


def test_an_event_leads_to_its_time(page):
    page.wait("document.querySelectorAll('#events li').length > 3")
    seek(page, 30)
    page.ask("document.querySelector('#events li').click()")
    page.wait("document.querySelector('#now').textContent === '0.0'")


def test_every_layer_can_be_switched_off(page):
    painted = "document.querySelector('#map').toDataURL()"
    seek(page, 30)
    for name in ("95 % ellipses", "numbers", "online paths", "truth", "events"):
        page.ask("new Promise((done) => setTimeout(done, 200))")
        page.wait(f"window.before === (window.before = {painted})")  # it has come to rest
        page.ask(f"[...document.querySelectorAll('#layers button')]"
                 f".find((b) => b.textContent === '{name}').click()")  # fmt: skip
        page.wait(f"{painted} !== window.before")


def test_traffic_and_errors_are_told(page):
    page.wait("document.querySelectorAll('#traffic tbody tr').length >= 10")
    assert "keys" in page.text("#traffic-total")
    page.ask("document.querySelector('[data-robot=r3]').click()")
    page.wait("document.querySelector('#errors-of').textContent === 'r3'")
    assert 0.0 < float(page.text("[data-robot=r3] td:nth-child(6)")) < 2.0


def test_the_map_is_written_as_svg_with_all_that_is_shown(page):
    seek(page, 30)
    written = ElementTree.fromstring(page.ask("teamslam.map.svg(30)"))
    words = [each.text for each in written.iter("{http://www.w3.org/2000/svg}text")]
    assert {"r1", "r2", "r3"} <= set(words)
    shown = page.ask("[...teamslam.store.mapAt(30).ids].map(String)")
    assert set(shown) <= set(words)
    paths = [each.get("d", "") for each in written.iter("{http://www.w3.org/2000/svg}path")]
    assert len(paths) > 2 * len(shown)
    assert not any("NaN" in path for path in paths)


@pytest.mark.parametrize(("ends", "drawn"), [(True, 3), (False, 1)])
def test_smoothed_poses_at_ends_of_submaps_are_dots_without_chords(page, ends, drawn):
    def shapes() -> int:
        return page.ask("teamslam.map.svg(30)").count("<path")

    seek(page, 30)
    before = shapes()
    frame = {"k": "path", "r": "r1", "t": [10, 20, 30], "v": [0, 0, 0, 4, 0, 0, 4, 4, 0]}
    page.ask(f"teamslam.store.take({json.dumps({**frame, 'ends': ends})})")
    assert shapes() - before == drawn


def test_after_a_jump_only_the_latest_messages_are_on_their_way(page):
    page.ask("teamslam.seek(5); teamslam.seek(60)")
    page.wait("teamslam.state.time === 60")
    page.ask("new Promise((done) => setTimeout(done, 200))")
    assert page.ask("teamslam.map.pace") == page.ask("teamslam.state.speed")


def test_the_keyboard_moves_time_and_follows_a_robot(page):
    seek(page, 30)
    for name, key in (("ArrowRight", "ArrowRight"), ("ArrowLeft", "ArrowLeft"), ("r", "r")):
        page.call("Input.dispatchKeyEvent", type="keyDown", key=key)
        page.call("Input.dispatchKeyEvent", type="keyUp", key=key)
        page.ask("new Promise((done) => setTimeout(done, 60))")
        assert page.ask("teamslam.state.time") == {"ArrowRight": 31}.get(name, 30)
    assert page.ask("teamslam.map.follow") == "r1"
    page.wait(
        "(() => { const [x, y] = teamslam.map.placeAt(teamslam.store.robots.get('r1'), 30);"
        "const [a, b] = teamslam.map.centre; return Math.hypot(x - a, y - b) < 1e-6; })()"
    )
    page.call("Input.dispatchKeyEvent", type="keyDown", key="f")
    page.wait("teamslam.map.follow === null && teamslam.map.fitted")


def test_every_control_is_reached_by_tab(page):
    reached = page.ask(
        "[...document.querySelectorAll('button, select, input, summary, [tabindex]')]"
        ".filter((e) => e.offsetParent && e.tabIndex < 0).length"
    )
    assert reached == 0
    page.ask("document.querySelector('#events li').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="Enter")
    page.wait("document.querySelector('#now').textContent === '0.0'")


def test_an_event_of_a_robot_is_where_the_robot_was(page):
    event = "teamslam.store.events.find((e) => e.x === 'r1 is in the team\\'s map')"
    place = page.ask(f"teamslam.store.placeOf({event})")
    at = page.ask(f"teamslam.map.placeAt(teamslam.store.robots.get('r1'), {event}.t).slice(0, 2)")
    assert place == pytest.approx(at)
    seek(page, 30)
    page.wait("teamslam.map.marks.length > 0")


@pytest.fixture(scope="module")
def changed_url(tmp_path_factory):
    """Address of a log whose final map differs from a saved map, in an arbitrary frame."""
    path = tmp_path_factory.mktemp("changed") / "log.mcap"
    changes = (
        m.LandmarkChange(landmark=1, state="unchanged"),
        m.LandmarkChange(landmark=2, state="moved", dx=12.0, dy=-5.0, sigma=0.125, chi2=87.0),
        m.LandmarkChange(landmark=5, state="gone", expected=9.0),
        m.LandmarkChange(landmark=8, state="new"),
    )
    samples = []
    for each in crowd(ROBOTS, LANDMARKS, SECONDS):
        message = opened(each)[2]
        if isinstance(message, m.InitialPose):
            message = msgspec.structs.replace(message, pose=b"")
        if isinstance(message, m.FusedMap):
            means = floats(message.means, "means").reshape(-1, 2) + MOVED_FRAME
            message = msgspec.structs.replace(
                message, frame="r1/1", means=from_floats(means),
                changes=changes if message.final else (),
            )  # fmt: skip
        samples.append(msgspec.structs.replace(each, payload=encoded(message)))
    with Recorder(path, "crowd", {}) as recorder:
        recorder.write(samples)
    with session(path, "127.0.0.1", 0, None, growing=False) as shown:
        yield shown.url


@pytest.fixture
def changed(browser, changed_url):
    open_page(browser, changed_url)
    browser.wait("document.querySelector('#count-moved').textContent === '1'")
    return browser


def test_changes_since_a_saved_map_are_counted_and_explained_where_the_pointer_is(changed):
    counts = [changed.text(f"#count-{name}") for name in ("moved", "gone", "new", "unchanged")]
    assert counts == ["1", "1", "1", "1"]
    assert changed.text("#changes li") == "2moved by (+12.000, −5.000) ± 0.125 m"
    for landmark, words in ((2, "± 0.125 m, χ² 87"), (5, "9 observations were due"), (8, "new")):
        row = f"teamslam.map.store.mapAt(teamslam.state.time).changes.of.get({landmark})"
        x, y = changed.ask(
            f"(() => {{ const c = {row}, m = teamslam.map;"
            "const b = m.canvas.getBoundingClientRect(), [u, v] = m.screen(c.x, c.y);"
            "return [b.x + u / m.ratio, b.y + v / m.ratio]; })()"
        )
        changed.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        changed.wait(f"document.querySelector('#map').title.includes({words!r})")
    painted = "document.querySelector('#map').toDataURL()"
    changed.wait(f"window.before === (window.before = {painted})")
    changed.click("[data-layer=changes]")
    changed.wait(f"{painted} !== window.before")
    seek(changed, 30)
    changed.wait("document.querySelector('#count-moved').textContent === '–'")
    assert changed.errors == []


def test_a_log_without_a_saved_map_has_no_changes(page):
    assert page.ask("document.querySelector('#changes-card').hidden")
    assert page.ask("document.querySelector('[data-layer=changes]').hidden")


def test_the_truth_is_shown_in_the_frame_of_the_map_and_not_before_there_is_one(changed):
    found = changed.ask("teamslam.store.truthAt(teamslam.state.time)")
    assert found[:2] == pytest.approx(MOVED_FRAME, abs=0.5)
    assert found[2] == pytest.approx(0.0, abs=0.02)
    assert changed.ask("teamslam.store.truthAt(1)") is None
    changed.ask("teamslam.map.on.truth = false")
    extent = changed.ask("teamslam.store.extent()")
    assert extent == changed.ask("teamslam.store.box")


def test_the_name_of_a_robot_covers_no_number_of_a_landmark(page):
    covered = page.ask(
        "(() => { const m = teamslam.map, sides = new Set(); let covered = 0, names = 0;"
        f"for (let t = 20; t <= {SECONDS}; t += 0.5) {{"
        "  m.draw(t); const numbers = m.landmarkBoxes(m.store.mapAt(t));"
        "  for (const a of m.names) { names++;"
        "    covered += numbers.some((b) => Math.min(a[2], b[2]) > Math.max(a[0], b[0])"
        "      && Math.min(a[3], b[3]) > Math.max(a[1], b[1])); }"
        "  for (const side of m.sides.values()) sides.add(side); }"
        "return [covered, names, sides.size > 1]; })()"
    )
    assert covered == [0, ROBOTS * 81, True]


CONTRASTS = """
(() => {
  const paint = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const channels = (colour) => {
    paint.clearRect(0, 0, 1, 1);
    paint.fillStyle = colour;
    paint.fillRect(0, 0, 1, 1);
    return [...paint.getImageData(0, 0, 1, 1).data];
  };
  const over = (under, colour, opacity) => {
    const [r, g, b, alpha] = channels(colour), share = alpha / 255 * opacity;
    return [r, g, b].map((value, i) => value * share + under[i] * (1 - share));
  };
  const linear = (value) => (value / 255 + 0.055) ** 2.4 / 1.055 ** 2.4;  // above 0.04
  const luminance = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const found = {};
  for (const each of document.querySelectorAll('header *, aside *, footer *')) {
    const texts = [...each.childNodes].filter((node) => node.nodeType === Node.TEXT_NODE);
    if (!each.offsetParent || !texts.some((node) => node.textContent.trim())) continue;
    let opacity = 1;
    const styles = [];
    for (let e = each; e; e = e.parentElement) styles.unshift(getComputedStyle(e));
    for (const style of styles) opacity *= Number(style.opacity);
    const ground = styles.reduce((under, s) => over(under, s.backgroundColor, 1), [255, 255, 255]);
    const text = over(ground, getComputedStyle(each).color, opacity);
    const [low, high] = [luminance(ground), luminance(text)].sort((a, b) => a - b);
    found[`${each.tagName} ${each.textContent.trim()}`] = (high + 0.05) / (low + 0.05);
  }
  return found;
})()
"""


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_every_text_stands_out_from_its_ground(page, scheme):
    page.call(
        "Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}]
    )
    seek(page, 30)  # later events are grey
    ratios = page.ask(CONTRASTS)
    page.call("Emulation.setEmulatedMedia", features=[])
    assert len(ratios) > 40
    assert {text: ratio for text, ratio in ratios.items() if ratio < 4.5} == {}


def test_it_fits_a_phone(page):
    page.size(390, 844, 2.0, touch=True)
    page.wait("document.documentElement.scrollWidth <= 390")
    page.wait(
        "['#play', '#slider', '#speed', '#map', '#landmarks'].every((s) => {"
        "const b = document.querySelector(s).getBoundingClientRect();"
        "return b.left >= 0 && b.right <= 390 && b.bottom <= 844 && b.width > 10; })"
    )


async def test_a_live_team_is_followed_and_the_page_stays_until_ctrl_c(team, tmp_path, browser):
    launch = await team.start(
        *("launch", short(tmp_path), "--speed", "10", "--output", tmp_path / "run"),
        *("--view", "--no-browser", "--foxglove-port", "0", "--no-report"),
    )
    await launch.says("page  ")
    found = re.search(r"page\s+(http://\S+)", launch.said())
    browser.errors.clear()
    browser.size(1280, 800)
    await asyncio.to_thread(browser.open, found[1])
    await asyncio.to_thread(
        browser.wait, "Number(document.querySelector('#landmarks').textContent) > 0", 120.0
    )
    seen = now(browser)
    await asyncio.to_thread(browser.wait, "window.teamslam.store.complete", 120.0)
    await asyncio.to_thread(browser.wait, "document.querySelector('#badge').textContent === 'LOG'")
    assert now(browser) >= seen > 0.0
    assert "final map" in browser.text("#events")
    assert browser.errors == []
    await until(lambda: "until Ctrl-C" in launch.said(), "the launch has ended", 120.0)
    launch.signal(signal.SIGINT)
    assert await launch.ended() == 0
