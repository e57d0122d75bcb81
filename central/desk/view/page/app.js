// The page: the stream of frames into the store, the time, and what is shown at it.

import { CHANGES, LAYERS, MARKS, MapView, gridStep } from './mapview.js';
import { Plot, colour } from './plots.js';
import { Store, inOrder, upTo } from './store.js';

const WARN = 1.1, FAIL = 1.3;  // of the joint cost per degree of freedom, as the centre's monitor
const SCALE_WARN = Math.SQRT2; // of the covariance scale, and its inverse
const TEXT_MS = 160;           // between two looks of tables
const TRAFFIC_ROWS = 40, CHANGE_ROWS = 40;
const $ = (id) => document.getElementById(id);

const store = new Store();
const map = new MapView($('map'), store);
const state = { time: 0, playing: false, speed: 10, following: true, chosen: null, picked: false, touched: false };
const plots = ['plot-x', 'plot-y', 'plot-heading', 'plot-cost', 'plot-nis'].map((id) => new Plot($(id), seek));

function end() { return Math.max(store.now, 1e-9); }

function seek(time) {
  state.time = Math.min(Math.max(time, 0), end());
  state.following = !store.complete && state.time >= end() - 1e-6;
  state.touched = true;
}

function play(playing) {
  state.playing = playing;
  state.touched = true;
  if (playing && state.time >= end() - 1e-6) {
    if (store.complete) state.time = 0; else state.following = true;
  }
}

// The stream.

let attempts = 0;
function connect() {
  const socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/stream`);
  socket.onmessage = (event) => {
    attempts = 0;
    document.body.dataset.state = 'open';
    for (const frame of JSON.parse(event.data)) store.take(frame);
    if (!state.picked && store.robots.size) choose([...store.robots.keys()][0]);
  };
  socket.onclose = () => {
    document.body.dataset.state = 'closed';
    if (!store.complete) setTimeout(connect, Math.min(500 * 2 ** attempts++, 8000));
  };
}

// The controls.

function pick(name) {
  state.picked = true;
  choose(name);
}

function choose(name) {
  if (state.chosen === name) return;
  state.chosen = map.chosen = name;
  lookedAt = 0;
}

function follow(name) {
  map.follow = name;
  if (name && map.fitted) map.zoom(3);
  $('follow').setAttribute('aria-pressed', String(Boolean(name)));
  lookedAt = 0;
}

function showAll() {
  follow(null);
  map.fit();
}

map.onMove = () => follow(null);
map.onPick = (x, y) => {
  $('why').textContent = linesAt(x, y).join('\n');
  $('why').hidden = !$('why').textContent;
};
map.onHover = (x, y) => { map.canvas.title = linesAt(x, y).join('\n'); };

/** The events and the landmark that are shown at a place on the screen, in words. */
function linesAt(x, y) {
  const shown = store.mapAt(state.time);
  const i = map.landmarkAt(shown, x, y), events = map.eventsAt(x, y);
  return [...events.map((event) => `${event.t.toFixed(0)} s: ${event.x}`), ...(i < 0 ? [] : landmarkLines(shown, i))];
}

function landmarkLines(shown, i) {
  const change = shown.changes && shown.changes.of.get(shown.ids[i]);
  const lines = membershipLines(shown, i);
  if (!change) return lines;
  const test = change.state === 'moved' ? `, χ² ${change.chi2.toFixed(0)} of 2 degrees of freedom` : '';
  return [...lines, `since the saved map: ${changeText(change)}${test}`];
}

function changeText({ state: now, dx, dy, sigma, expected }) {
  if (now === 'moved') return `moved by (${signed(dx)}, ${signed(dy)}) ± ${sigma.toFixed(3)} m`;
  return now === 'gone' ? `gone: not seen, though ${expected.toFixed(0)} observations were due` : 'new';
}

function signed(v) { return `${v < 0 ? '−' : '+'}${Math.abs(v).toFixed(3)}`; }

function membershipLines(shown, i) {
  return shown.why && shown.why[i].length
    ? [`landmark ${shown.ids[i]}, ${shown.n[i] === 1 ? 'tentative: one submap has it' : `confirmed by ${shown.n[i]}${!shown.final && shown.n[i] === 12 ? ' or more' : ''} submaps`}`, ...shown.why[i]]
    : [`landmark ${shown.ids[i]}, known by its name`];
}

// Files of what is shown.

function download(blob, ending) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = `${store.hello.team}-${state.time.toFixed(0)}s.${ending}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

$('png').addEventListener('click', () => { map.draw(state.time); map.canvas.toBlob((blob) => download(blob, 'png')); });
$('svg').addEventListener('click', () => download(new Blob([map.svg(state.time)], { type: 'image/svg+xml' }), 'svg'));

$('layers').parentElement.open = innerWidth > 860;  // on a phone they would hide the map
for (const [name, text] of LAYERS) {
  const button = document.createElement('button');
  button.textContent = text;
  button.dataset.layer = name;
  button.hidden = name === 'changes';  // until there is a saved map
  button.setAttribute('aria-pressed', String(map.on[name]));
  button.addEventListener('click', () => {
    map.on[name] = !map.on[name];
    button.setAttribute('aria-pressed', map.on[name]);
  });
  $('layers').append(button);
}
$('zoom-in').addEventListener('click', () => map.zoom(1.4));
$('zoom-out').addEventListener('click', () => map.zoom(1 / 1.4));
$('fit').addEventListener('click', showAll);
$('follow').addEventListener('click', () => follow(map.follow ? null : state.chosen));
$('play').addEventListener('click', () => play(!moving()));
$('speed').addEventListener('change', () => { state.speed = Number($('speed').value); });
$('live').addEventListener('click', () => { state.following = true; state.playing = false; });
$('slider').addEventListener('input', () => { state.playing = false; seek(($('slider').value / 1000) * end()); });
addEventListener('keydown', (event) => {
  if (event.target.matches('select') || event.ctrlKey || event.metaKey || event.altKey) return;
  const step = event.shiftKey ? 10 : 1;
  const done = {
    ' ': () => play(!moving()), f: showAll, r: () => follow(map.follow ? null : state.chosen),
    '+': () => map.zoom(1.4), '-': () => map.zoom(1 / 1.4),
    ArrowRight: () => { state.playing = false; seek(state.time + step); },
    ArrowLeft: () => { state.playing = false; seek(state.time - step); },
    Home: () => { state.playing = false; seek(0); }, End: () => seek(end()),
  }[event.key];
  if (done && !(event.key === ' ' && event.target.matches('button, summary'))) { event.preventDefault(); done(); }
});
matchMedia('(prefers-color-scheme: light)').addEventListener('change', () => {
  map.readColours();
  for (const plot of plots) plot.key = '';
});

function moving() { return state.playing || (state.following && !store.complete); }

// Time.

let before = performance.now();
let lookedAt = 0;
let drawn = '';
function turn(now) {
  requestAnimationFrame(turn);
  const passed = Math.min((now - before) / 1000, 0.25);
  before = now;
  if (!store.hello) return;
  const earlier = state.time;
  if (store.complete && !state.touched) state.time = end();
  else if (state.following && !store.complete) {
    state.playing = false;
    state.time += (end() - state.time) * Math.min(1, 5 * passed);
    if (end() - state.time < 1e-3) state.time = end();
  } else if (state.playing) {
    state.time = Math.min(state.time + passed * state.speed, end());
    if (state.time >= end()) {
      state.playing = false;
      state.following = !store.complete;
    }
  }
  if (!moving() || state.playing) map.pace = state.speed;  // also after a jump, and once a log is loaded
  else if (passed > 0) map.pace = Math.max(0.95 * map.pace + 0.05 * ((state.time - earlier) / passed), 1);
  const wanted = `${state.time}|${store.version}|${map.centre}|${map.scale}|${map.chosen}|${map.fitted}|${Object.values(map.on)}|${innerWidth}|${innerHeight}`;
  if (wanted !== drawn || map.pending || map.canvas.width !== Math.round(map.canvas.clientWidth * map.ratio)) {
    drawn = wanted;
    map.draw(state.time);
    drawPlots();
    const share = (1000 * state.time) / end();
    if (document.activeElement !== $('slider') || moving()) $('slider').value = share;
    $('now').textContent = state.time.toFixed(1);
  }
  if (now - lookedAt > TEXT_MS) {
    lookedAt = now;
    look();
  }
}

// What is written.

let written = '';
function look() {
  const key = `${state.time.toFixed(2)}|${store.version}|${state.chosen}|${moving()}|${document.body.dataset.state}|${map.scale}`;
  if (key === written) return;
  written = key;
  const { hello } = store;
  $('team').textContent = hello.title;
  document.title = `${hello.team} · teamslam`;
  const live = hello.live && !store.complete;
  const lost = !store.complete && document.body.dataset.state === 'closed';
  $('badge').hidden = false;
  $('badge').className = lost ? 'lost' : live ? '' : 'log';
  $('badge').textContent = lost ? 'CONNECTION LOST' : live ? 'LIVE' : store.complete ? 'LOG' : 'READING';
  $('live').hidden = !live;
  $('live').setAttribute('aria-pressed', String(state.following));
  $('play').setAttribute('aria-label', moving() ? 'pause' : 'play');
  $('play').querySelector('path').setAttribute('d', moving() ? 'M7 4h4v16H7zM14 4h4v16h-4z' : 'M7 4l13 8-13 8z');
  $('end').textContent = end().toFixed(0);
  $('empty').hidden = [...store.robots.values()].some((robot) => robot.pose.length) || store.maps.length > 0;
  $('empty').textContent = store.complete ? 'This log has no poses and no map.' : 'waiting for the team …';
  $('follow').title = $('follow').ariaLabel = `follow ${map.follow || state.chosen || 'a robot'} (R)`;
  lookAtWaiting();
  lookAtMap();
  lookAtChanges();
  lookAtRobots();
  lookAtPeers();
  lookAtEvents();
  lookAtTraffic();
  const metres = gridStep(map.scale) * 2;
  $('scale').firstElementChild.style.width = `${metres * map.scale}px`;
  $('scale').lastElementChild.textContent = metres >= 1 ? `${metres} m` : `${Math.round(metres * 100)} cm`;
}

/** What a running team waits for, by the states of its nodes. */
function lookAtWaiting() {
  const nodes = new Map();
  for (const [node, states] of store.complete ? [] : store.awaited) {
    for (const each of states) nodes.set(each, [...(nodes.get(each) || []), node]);
  }
  const lines = [...nodes].map(([each, of]) => `${of.join(', ')}: ${each}`);
  if (!store.complete && document.body.dataset.state === 'closed') lines.push('no connection to the server of this page: it is tried again');
  else if (!store.robots.size) lines.push(store.complete ? 'the log has no poses' : 'no pose of a robot yet');
  $('empty').hidden = !lines.length;
  $('empty').textContent = lines.join('\n');
}

function put(id, text, level = '') {
  $(id).textContent = text;
  $(id).className = level;
}

function levelOf(cost) { return cost > FAIL ? 'bad' : cost > WARN ? 'warn' : ''; }

function lookAtMap() {
  const shown = store.mapAt(state.time);
  put('landmarks', shown ? shown.ids.length : '0');
  const here = [...store.robots.values()].filter((r) => store.isOutside(r, state.time) || r.pose.at(state.time) >= 0);
  put('robot-count', here.filter((r) => store.stateAt(r, state.time) !== 'lost').length);
  $('rmse-box').hidden = !store.trueMap;
  $('nees-box').hidden = !store.trueMap || !shown || shown.nees === null;
  put('rmse', shown && shown.rmse !== null ? metresText(shown.rmse) : '–');
  put('nees', shown && shown.nees !== null ? shown.nees.toFixed(2) : '–', '');
  const figures = store.figuresAt('central', state.time);
  const cost = figures && figures.joint_cost_per_dof;
  $('cost-box').hidden = !store.figures.has('central');
  put('cost', cost ? cost.toFixed(2) : '–', cost ? levelOf(cost) : '');
  const scale = figures && figures.covariance_scale;
  $('covariance-scale-box').hidden = !scale;
  put('covariance-scale', scale ? scale.toFixed(2) : '–', scale && scaleSays(scale) ? 'warn' : '');
}

/** The warning about covariances of this scale; empty without one. */
function scaleSays(scale) {
  if (scale > SCALE_WARN) return `the reported covariances are too small by a factor of ${scale.toFixed(1)}`;
  return scale < 1 / SCALE_WARN ? `the reported covariances are too large by a factor of ${(1 / scale).toFixed(1)}` : '';
}

function metresText(v) { return v < 0.995 ? `${(100 * v).toFixed(v < 0.0995 ? 1 : 0)} cm` : `${v.toFixed(2)} m`; }

/** Counts of the landmarks by their state against the saved maps, and what has changed. */
let changesShown;
function lookAtChanges() {
  $('changes-card').hidden = document.querySelector('[data-layer=changes]').hidden = !store.hasChanges;
  const shown = store.mapAt(state.time), changes = shown && shown.changes;
  if (changesShown === changes) return;
  changesShown = changes;
  $('changes-say').textContent = `since the saved map${changes ? '' : '; with the final map'}`;
  const rows = changes ? changes.rows : [], states = Object.keys(CHANGES);
  for (const name of states) $(`count-${name}`).textContent = changes ? rows.filter((row) => row.state === name).length : '–';
  $('count-unchanged').textContent = changes ? changes.unchanged : '–';
  const listed = [...rows].sort((a, b) => states.indexOf(a.state) - states.indexOf(b.state)).slice(0, CHANGE_ROWS);
  $('changes').replaceChildren(...listed.map((row) => {
    const item = document.createElement('li'), name = document.createElement('b'), text = document.createElement('span');
    item.tabIndex = 0;
    name.textContent = row.landmark;
    text.textContent = changeText(row);
    text.className = row.state;
    item.append(name, text);
    const show = () => map.show(row.x, row.y);
    item.addEventListener('click', show);
    item.addEventListener('keydown', (pressed) => { if (pressed.key === 'Enter') show(); });
    return item;
  }));
  const more = rows.length - listed.length;
  $('changes-more').hidden = !more;
  $('changes-more').textContent = `and ${more} more: the report and its JSON list all`;
}

const rows = new Map();
function lookAtRobots() {
  const body = $('robots').tBodies[0];
  const known = [...store.robots.values()];
  if (known.length !== rows.size) {
    rows.clear();
    body.replaceChildren(...known.map((robot) => {
      const row = document.createElement('tr');
      row.dataset.robot = robot.name;
      row.tabIndex = 0;
      row.title = 'show its errors; twice, or R: follow it';
      const cells = Array.from({ length: 6 }, () => row.insertCell());
      const dot = document.createElement('i');
      dot.className = 'dot';
      const note = document.createElement('small');
      cells[0].append(dot, robot.name, note);
      row.addEventListener('click', () => pick(robot.name));
      row.addEventListener('dblclick', () => follow(robot.name));
      row.addEventListener('keydown', (event) => { if (event.key === 'Enter') pick(robot.name); });
      rows.set(robot.name, { row, cells, dot, note });
      return row;
    }));
    $('error-tabs').replaceChildren(...known.map((robot) => {
      const tab = document.createElement('button');
      tab.textContent = robot.name;
      tab.dataset.robot = robot.name;
      tab.setAttribute('role', 'tab');
      tab.addEventListener('click', () => pick(robot.name));
      return tab;
    }));
    $('error-tabs').hidden = known.length < 2;
  }
  const errors = known.some((robot) => robot.error.length);
  $('error-head').textContent = errors ? 'error [m]' : '';
  for (const robot of known) {
    const { row, cells, dot, note } = rows.get(robot.name);
    row.classList.toggle('chosen', robot.name === state.chosen);
    dot.style.background = robot.colour;
    const now = store.stateAt(robot, state.time);
    note.textContent = now === 'lost' ? 'lost' : store.isOutside(robot, state.time) ? 'not in the team\u2019s frame' : now === 'done' || now === 'left' ? 'done' : '';
    note.className = now === 'lost' || store.isOutside(robot, state.time) ? '' : 'done';
    const i = store.poseAt(robot, state.time);
    const texts = i < 0 ? ['–', '–', '–', '–', ''] : poseTexts(robot, i);
    texts.forEach((text, k) => { cells[k + 1].textContent = text; });
    const e = robot.error.at(state.time);
    const out = e >= 0 && (Math.abs(robot.error.get(e, 0)) > robot.error.get(e, 3) || Math.abs(robot.error.get(e, 1)) > robot.error.get(e, 4));
    cells[5].textContent = e < 0 || i < 0 ? '' : Math.hypot(robot.error.get(e, 0), robot.error.get(e, 1)).toFixed(2);
    cells[5].className = out ? 'bad' : '';
  }
  for (const tab of $('error-tabs').children) tab.setAttribute('aria-selected', String(tab.dataset.robot === state.chosen));
}

function poseTexts(robot, i) {
  const [x, y, heading, xx, xy, yy] = [0, 1, 2, 3, 4, 5].map((k) => robot.pose.get(i, k));
  const worst = 3 * Math.sqrt((xx + yy) / 2 + Math.hypot((xx - yy) / 2, xy));
  return [x.toFixed(2), y.toFixed(2), `${((heading * 180) / Math.PI).toFixed(0)}°`, worst.toFixed(2), ''];
}

/** What each peer has of the team's set, how old it is, and what its talk costs against a star. */
function lookAtPeers() {
  const now = new Map();
  for (const node of store.figures.keys()) {
    const figures = store.figuresAt(node, state.time);
    if (figures && figures.set_submaps !== undefined) now.set(node, figures);
  }
  $('peers-card').hidden = !now.size;
  if (!now.size) return;
  const names = [...now.keys()].sort(inOrder.compare);
  const whole = Math.max(...names.map((node) => now.get(node).set_submaps));
  const newest = new Map();
  for (const figures of now.values()) {
    for (const [name, v] of Object.entries(figures)) {
      if (name.startsWith('set_newest_s.')) newest.set(name.slice(13), Math.max(v, newest.get(name.slice(13)) ?? -Infinity));
    }
  }
  const body = $('peers').tBodies[0];
  while (body.rows.length > names.length) body.deleteRow(-1);
  while (body.rows.length < names.length) { const row = body.insertRow(); for (let i = 0; i < 5; i++) row.insertCell(); row.cells[2].append(document.createElement('span'), document.createElement('small')); }
  const robots = names.filter((node) => node.startsWith('robot/')).length;
  let agreed = 0;
  names.forEach((node, i) => {
    const figures = now.get(node), own = node.replace('robot/', ''), cells = body.rows[i].cells;
    const star = ['submap', 'sighting_factor'].reduce((sum, kind) => sum + bytesOf(`${node}/${kind}`), 0);
    const since = sameSince(node, robots - Number(node.startsWith('robot/')));
    agreed += since !== null;
    cells[0].textContent = own;
    cells[1].textContent = `${figures.set_submaps} / ${whole}`;
    cells[1].className = figures.set_submaps < whole ? 'warn' : '';
    cells[2].firstChild.textContent = [...newest].filter(([name]) => name !== own).sort((a, b) => inOrder.compare(a[0], b[0])).map(([name, at]) => {
      const have = figures[`set_newest_s.${name}`];
      return figures[`set_submaps.${name}`] ? `${name} ${Math.max(0, at - have).toFixed(0)} s` : `${name} –`;
    }).join(', ');
    cells[3].textContent = since === null ? '–' : `${since.toFixed(0)} s`;
    const times = (bytes) => (star ? `${(bytes / star).toFixed(1)} ×` : bytesText(bytes));
    cells[4].textContent = `${times(figures.set_uplink_bytes)}, ${times(figures.set_downlink_bytes)}`;
    cells[4].title = `${bytesText(figures.set_uplink_bytes)} said, ${bytesText(figures.set_downlink_bytes)} heard, ${bytesText(star)} of its own submaps`;
    const over = Object.entries(figures).filter(([name, v]) => name.startsWith('set_over.') && v)
      .map(([name, v]) => [name.slice(9).replace('robot/', ''), v]).filter(([name]) => name !== own).sort((a, b) => b[1] - a[1]);
    cells[2].lastChild.textContent = over.length ? `over ${over.slice(0, 5).map(([name, v]) => `${name} ${v}`).join(', ')}` : '';
  });
  $('peers-say').textContent = agreed === names.length ? 'all have the same set' : `${agreed} of ${names.length} have heard that all robots have the same set`;
}

/** Since when a peer has heard of so many others that their sets are its own; null: it has not. */
function sameSince(node, others) {
  const { t, f } = store.figures.get(node);
  let i = upTo(t, state.time) - 1, since = null;
  for (; i >= 0 && f[i].set_agrees >= others; i--) since = t[i];
  return since;
}

function bytesOf(key) {
  const of = store.traffic.get(key);
  const i = of ? upTo(of.t, state.time) - 1 : -1;
  return i < 0 ? 0 : of.b[i];
}

let listed = null, newest = null;
function lookAtEvents() {
  const list = $('events');
  if (listed !== store.events.length || list.store !== store.hello) {
    listed = store.events.length;
    list.store = store.hello;
    list.replaceChildren(...store.events.map((event) => {
      const item = document.createElement('li');
      item.tabIndex = 0;
      const time = document.createElement('time');
      time.textContent = `${event.t.toFixed(0)} s`;
      const text = document.createElement('span');
      text.textContent = event.x;
      text.className = event.e;
      item.append(time, text);
      const show = () => {
        state.playing = false;
        seek(event.t);
        const place = store.placeOf(event);
        if (place) map.show(...place);
      };
      item.addEventListener('click', show);
      item.addEventListener('keydown', (pressed) => { if (pressed.key === 'Enter') show(); });
      return item;
    }));
    drawTicks();
  }
  if (ticked !== end()) drawTicks();
  let last = null;
  store.events.forEach((event, i) => {
    const future = event.t > state.time + 1e-6;
    list.children[i].classList.toggle('future', future);
    if (!future) last = list.children[i];
  });
  if (last && last !== newest) list.scrollTop = last.offsetTop + last.offsetHeight - list.clientHeight + 8;
  newest = last;
}

let ticked = 0;
function drawTicks() {
  ticked = end();
  const canvas = $('ticks'), ratio = Math.min(devicePixelRatio || 1, 2);
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  const g = canvas.getContext('2d'), half = 8 * ratio;
  for (const event of store.events) {
    if (!MARKS[event.e]) continue;
    g.fillStyle = colour(MARKS[event.e]);
    g.fillRect(half + (event.t / end()) * (canvas.width - 2 * half) - ratio, 0, 2 * ratio, 6 * ratio);
  }
}

function lookAtTraffic() {
  const found = [];
  let total = 0;
  for (const [key, of] of store.traffic) {
    const i = upTo(of.t, state.time) - 1;
    if (i >= 0) { found.push([key, of.m[i], of.b[i]]); total += of.b[i]; }
  }
  found.sort((a, b) => b[2] - a[2]);
  const rate = state.time > 0 ? ` · ${bytesText(total / state.time)}/s` : '';
  const listed = found.length > TRAFFIC_ROWS ? `, the largest ${TRAFFIC_ROWS} here` : '';
  $('traffic-total').textContent = found.length ? `${bytesText(total)}${rate} of ${found.length} keys${listed}` : '';
  const body = $('traffic').tBodies[0];
  const shown = found.slice(0, TRAFFIC_ROWS);
  while (body.rows.length > shown.length) body.deleteRow(-1);
  while (body.rows.length < shown.length) { const row = body.insertRow(); row.insertCell(); row.insertCell(); row.insertCell(); }
  shown.forEach(([key, messages, bytes], i) => {
    const [name, count, size] = body.rows[i].cells;
    name.textContent = name.title = key;
    name.style.setProperty('--share', `${(100 * bytes) / shown[0][2]}%`);
    count.textContent = messages.toLocaleString('en');
    size.textContent = bytesText(bytes);
  });
}

function bytesText(n) {
  if (n < 1000) return `${n.toFixed(0)} B`;
  return n < 1e6 ? `${(n / 1e3).toFixed(n < 1e4 ? 1 : 0)} kB` : `${(n / 1e6).toFixed(n < 1e7 ? 2 : 1)} MB`;
}

// What is plotted.

const DEGREES = 180 / Math.PI;
function drawPlots() {
  const robot = store.robots.get(state.chosen);
  if (robot) {
    $('errors-of').textContent = robot.name;
    const { error, pose } = robot;
    const known = error.length > 0;
    $('no-truth').hidden = known;
    [['x', 'm', 1], ['y', 'm', 1], ['heading', '°', DEGREES]].forEach(([name, unit, factor], k) => {
      const variance = [3, 5, 6][k];
      const band = known
        ? { count: error.length, t: (i) => error.t[i], v: (i) => factor * error.get(i, 3 + k) }
        : { count: pose.length, t: (i) => pose.t[i], v: (i) => 3 * factor * Math.sqrt(pose.get(i, variance)) };
      const high = reach(robot, name, band, known ? { count: error.length, v: (i) => factor * error.get(i, k) } : null);
      plots[k].draw({
        key: `${robot.name}|${error.length}|${pose.length}|${robot.colour}`, title: unit === '°' ? 'heading [°]' : `${name} [m]`, unit: '', end: end(), time: state.time,
        low: -high, high, band,
        lines: known ? [{ colour: robot.colour, width: 1.5, count: error.length, t: (i) => error.t[i], v: (i) => factor * error.get(i, k) }] : [],
      });
    });
  }
  drawConsistency();
}

/** Half the height of an error's plot: a glitch of the truth, one in 200, may lie beyond. */
const reaches = new Map();
function reach(robot, name, band, line) {
  const key = `${robot.name} ${name}`, known = reaches.get(key);
  if (known && known.count === band.count && known.hello === store.hello) return known.high;
  const bounds = Array.from({ length: band.count }, (_, i) => band.v(i)).sort((a, b) => a - b);
  let high = bounds.length ? 1.7 * bounds[Math.floor(0.8 * (bounds.length - 1))] : 1;
  if (line) {
    const sizes = Array.from({ length: line.count }, (_, i) => Math.abs(line.v(i))).sort((a, b) => a - b);
    high = Math.max(high, 1.15 * sizes[Math.floor(0.995 * (sizes.length - 1))]);
  }
  high = Math.max(high, 1e-3);
  reaches.set(key, { count: band.count, high, hello: store.hello });
  return high;
}

function drawConsistency() {
  const found = store.figures.get('central');
  const costs = found ? found.f.map((f) => f.joint_cost_per_dof) : [];
  const lines = [];
  const legend = [];
  const line = (t, v, options) => lines.push({ count: t.length, t: (i) => t[i], v: (i) => v[i], ...options });
  let high = 1.5;
  if (found) {
    for (const robot of store.robots.values()) {
      const name = `joint_cost_per_dof.${robot.name}`;
      const kept = found.t.map((t, i) => [t, found.f[i][name]]).filter(([, v]) => v !== undefined);
      line(kept.map((k) => k[0]), kept.map((k) => k[1]), { colour: robot.colour, width: 1, alpha: 0.7 });
    }
    const kept = found.t.map((t, i) => [t, costs[i]]).filter(([, v]) => v !== undefined);
    line(kept.map((k) => k[0]), kept.map((k) => k[1]), { colour: colour('text'), width: 1.8 });
    if (kept.length) legend.push(['text', 'joint cost of the team, of each robot']);
    const scales = found.t.map((t, i) => [t, found.f[i].covariance_scale]).filter(([, v]) => v !== undefined);
    line(scales.map((k) => k[0]), scales.map((k) => k[1]), { colour: colour('warn'), width: 1.5 });
    if (scales.length) legend.push(['warn', 'covariance scale of the team']);
    legend.push(['warn', `above ${WARN}: covariances too small`, 'dashed'], ['bad', `above ${FAIL}: not to be trusted`, 'dashed']);
    for (const [, v] of [...kept, ...scales]) high = Math.max(high, Math.min(1.15 * v, 5));
  }
  drawInnovations();
  const i = found ? upTo(found.t, state.time) - 1 : -1;
  const cost = i < 0 ? undefined : costs[i];
  const scale = i < 0 ? undefined : found.f[i].covariance_scale;
  $('consistency-says').textContent = scale && scaleSays(scale) ? scaleSays(scale)
    : cost === undefined ? 'per degree of freedom; 1 is right'
    : cost > FAIL ? `${cost.toFixed(2)}: its covariances are not to be trusted` : cost > WARN ? `${cost.toFixed(2)}: its covariances are too small` : `${cost.toFixed(2)} per degree of freedom; 1 is right`;
  const key = `${found ? found.t.length : 0}|${store.maps.length}|${store.robots.size}`;
  plots[3].draw({
    key, title: 'per degree of freedom', unit: '', end: end(), time: state.time, low: 0, high, lines,
    levels: [{ v: 1, colour: 'good' }, { v: WARN, colour: 'warn' }, { v: FAIL, colour: 'bad' }],
  });
  if ($('cost-legend').dataset.key !== String(legend)) {
    $('cost-legend').dataset.key = String(legend);
    $('cost-legend').replaceChildren(...legend.map(([name, text, kind = '']) => {
      const item = document.createElement('span');
      item.className = kind;
      item.style.setProperty('--c', colour(name));
      item.textContent = text;
      return item;
    }));
  }
}

/** NIS of each robot: how well its measurements agree with what it expected of them. */
function drawInnovations() {
  const lines = [];
  let high = 2, count = 0;
  for (const robot of store.robots.values()) {
    const found = store.figures.get(`robot/${robot.name}`);
    if (!found) continue;
    const kept = found.t.map((t, i) => [t, found.f[i].nis_per_dof]).filter(([, v]) => v !== undefined);
    if (!kept.length) continue;
    count += kept.length;
    for (const [, v] of kept) high = Math.max(high, Math.min(1.15 * v, 6));
    lines.push({ count: kept.length, t: (i) => kept[i][0], v: (i) => kept[i][1], colour: robot.colour, width: 1.3 });
  }
  $('plot-nis').hidden = !lines.length;
  if (lines.length) {
    plots[4].draw({
      key: `${count}|${lines.length}`, title: "NIS per degree of freedom, of each robot's measurements", unit: '', end: end(),
      time: state.time, low: 0, high, lines, levels: [{ v: 1, colour: 'good' }],
    });
  }
}

addEventListener('resize', drawTicks);
window.teamslam = { store, state, map, seek, play };  // for the console and the tests
connect();
requestAnimationFrame(turn);
