// The frames of a team from the server, in the order of team time; t is seconds since the start.

/** The number of entries of ascending `t` that are not later than `time`. */
export function upTo(t, time) {
  let low = 0, high = t.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (t[middle] <= time) low = middle + 1; else high = middle;
  }
  return low;
}

/** Rows of `width` numbers by time; rows that are older than the last are left out. */
export class Series {
  constructor(width) { this.width = width; this.t = []; this.rows = []; }
  get length() { return this.t.length; }
  push(times, values) {
    for (let i = 0; i < times.length; i++) {
      if (this.t.length && times[i] < this.t[this.t.length - 1]) continue;
      this.t.push(times[i]);
      for (let k = 0; k < this.width; k++) this.rows.push(values[i * this.width + k]);
    }
  }
  at(time) { return upTo(this.t, time) - 1; }
  get(i, k) { return this.rows[i * this.width + k]; }
}

export const inOrder = new Intl.Collator('en', { numeric: true });  // r2 before r10
const POSE = 7;   // x, y, heading, xx, xy, yy, heading's variance
const ERROR = 7;  // x, y, heading, their 3σ, NEES per degree of freedom
const TRUTH = 3;
const SEEN = 3;   // landmark, −1 without identity, or teammate; ahead, left
const UNMOVED = [0, 0, 0];
const PLACED = /\blandmarks? (\d+)/;

function floats(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

function names(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Uint32Array(bytes.buffer);
}

export class Store {
  constructor() { this.clear(); }

  clear() {
    this.hello = null;
    this.robots = new Map();
    this.maps = [];
    this.mapTimes = [];
    this.trueMap = null;
    this.align = new Map();  // place of the truth in a map's frame that is not its own; null: undetermined
    this.hasChanges = false;
    this.figures = new Map();
    this.traffic = new Map();
    this.events = [];
    this.links = [];    // pulses: t, from, to
    this.linkTimes = [];
    this.awaited = new Map();
    this.hasCentre = false;
    this.now = 0;
    this.complete = false;
    this.version = 0;
    this.box = [Infinity, Infinity, -Infinity, -Infinity];
    this.trueBox = [...this.box];
  }

  robot(name) {
    let found = this.robots.get(name);
    if (!found) {
      found = {
        name, pose: new Series(POSE), error: new Series(ERROR), truth: new Series(TRUTH),
        clouds: [], cloudTimes: [], smoothed: new Series(TRUTH), atEnds: false, seen: new Series(SEEN), sensor: null, reach: 0, states: [], stateTimes: [], colour: '#888',
        outside: new Series(1), frames: new Series(0),
      };
      this.robots.set(name, found);
      this.robots = new Map([...this.robots].sort((a, b) => inOrder.compare(a[0], b[0])));
      [...this.robots.values()].forEach((robot, i) => { robot.colour = this.hello.colours[i % this.hello.colours.length]; });
    }
    return found;
  }

  extend(values, width, box = this.box) {
    for (let i = 0; i + 1 < values.length; i += width) {
      box[0] = Math.min(box[0], values[i]); box[1] = Math.min(box[1], values[i + 1]);
      box[2] = Math.max(box[2], values[i]); box[3] = Math.max(box[3], values[i + 1]);
    }
  }

  take(frame) {
    this.version++;
    switch (frame.k) {
      case 'hello': this.clear(); this.hello = frame; break;
      case 'now': this.now = Math.max(this.now, frame.t); break;
      case 'eof': this.complete = frame.complete; break;
      case 'pose': this.robot(frame.r).pose.push(frame.t, frame.v); this.extend(frame.v, POSE); break;
      case 'outside': this.robot(frame.r).outside.push([frame.t], [Number(frame.v)]); break;
      case 'frame': this.robot(frame.r).frames.push([frame.t], []); break;
      case 'err': this.robot(frame.r).error.push(frame.t, frame.v); break;
      case 'truth': this.robot(frame.r).truth.push(frame.t, frame.v); this.extend(frame.v, TRUTH, this.trueBox); break;
      case 'truth_map':
        this.trueMap = { ids: frame.ids, xy: frame.xy };
        this.extend(frame.xy, 2, this.trueBox);
        break;
      case 'map': this.takeMap(frame); break;
      case 'align': this.align.set(frame.f, frame.v); break;
      case 'cloud': {
        const robot = this.robot(frame.r);
        robot.clouds.push(floats(frame.v));
        robot.cloudTimes.push(frame.t);
        break;
      }
      case 'path': {
        const robot = this.robot(frame.r);
        robot.smoothed.push(frame.t, frame.v);
        robot.atEnds = frame.ends;
        break;
      }
      case 'sensor': this.robot(frame.r).sensor = frame; break;
      case 'see': this.takeSeen(this.robot(frame.r), frame); break;
      case 'link': this.takeLink(frame.t, frame.a, frame.b); break;
      case 'wait': this.awaited.set(frame.n, frame.x); break;
      case 'fig': {
        this.takeReceived(frame);
        if (!this.figures.has(frame.n)) this.figures.set(frame.n, { t: [], f: [] });
        const found = this.figures.get(frame.n);
        if (!found.t.length || frame.t >= found.t[found.t.length - 1]) {
          found.t.push(frame.t);
          found.f.push(frame.f);
        }
        break;
      }
      case 'bytes':
        for (const [key, t, messages, bytes] of frame.v) this.takeTraffic(key, t, messages, bytes);
        break;
      case 'ev': this.takeEvent(frame); break;
    }
  }

  takeMap(frame) {
    const map = { ...frame, ids: names(frame.ids), xy: floats(frame.xy), c: floats(frame.c), changes: null };
    if (frame.changes) {
      this.hasChanges = true;
      const rows = frame.changes.rows.map(([landmark, state, x, y, dx, dy, sigma, chi2, expected]) => ({
        landmark, state, x, y, dx, dy, sigma, chi2, expected,
      }));
      map.changes = { unchanged: frame.changes.unchanged, rows, of: new Map(rows.map((row) => [row.landmark, row])) };
      this.extend(rows.flatMap((row) => [row.x, row.y]), 2);
    }
    const last = this.mapTimes[this.mapTimes.length - 1];
    this.maps.push(map);
    this.mapTimes.push(last === undefined ? frame.t : Math.max(frame.t, last));
    this.extend(map.xy, 2);
  }

  takeSeen(robot, frame) {
    robot.seen.push(frame.t, frame.v);
    for (let i = 0; i < frame.v.length; i += SEEN) robot.reach = Math.max(robot.reach, Math.hypot(frame.v[i + 1], frame.v[i + 2]));
  }

  takeLink(t, from, to) {
    if (from === 'central') this.hasCentre = true;
    const i = upTo(this.linkTimes, t);
    this.links.splice(i, 0, { t, from, to });
    this.linkTimes.splice(i, 0, t);
  }

  /** A peer's count of a teammate's submaps that has grown is a submap that came over. */
  takeReceived({ n, t, f }) {
    const found = this.figures.get(n), before = found ? found.f[found.f.length - 1] : {};
    for (const [name, count] of Object.entries(f)) {
      const from = name.startsWith('set_submaps.') ? name.slice(12) : n.slice(6);
      if (from !== n.slice(6) && count > (before[name] || 0)) this.takeLink(t, from, n.slice(6));
    }
  }

  takeTraffic(key, t, messages, bytes) {
    let found = this.traffic.get(key);
    if (!found) this.traffic.set(key, found = { t: [], m: [], b: [] });
    const last = found.t.length - 1;
    found.t.push(last < 0 ? t : Math.max(t, found.t[last]));
    found.m.push((last < 0 ? 0 : found.m[last]) + messages);
    found.b.push((last < 0 ? 0 : found.b[last]) + bytes);
  }

  takeEvent(event) {
    let i = this.events.length;
    while (i > 0 && this.events[i - 1].t > event.t) i--;
    this.events.splice(i, 0, event);
    if (event.n.startsWith('robot/') && ['joined', 'restarted', 'lost', 'left', 'done'].includes(event.e)) {
      const robot = this.robot(event.n.slice(6));
      robot.states.push(event.e);
      robot.stateTimes.push(event.t);
    }
  }

  /** The map that was the newest at a time; null before the first. */
  mapAt(time) {
    const i = upTo(this.mapTimes, time) - 1;
    return i < 0 ? null : this.maps[i];
  }

  /** The place of the truth in the frame of the map at a time; null: undetermined, it is not shown. */
  truthAt(time) {
    const map = this.mapAt(time), found = this.align.get(map ? map.f : null);
    return found === undefined ? UNMOVED : found;
  }

  /** The extent of all that is shown; of the truth where it is in the map's frame. */
  extent() {
    const [a, b, c, d] = this.box, [e, f, g, h] = this.trueBox;
    return this.align.size ? this.box : [Math.min(a, e), Math.min(b, f), Math.max(c, g), Math.max(d, h)];
  }

  /** The row of a robot's pose at a time; −1 where it has none in the team's frame. */
  poseAt(robot, time) { return this.isOutside(robot, time) ? -1 : robot.pose.at(time); }

  isOutside(robot, time) {
    const i = robot.outside.at(time);
    return i >= 0 && robot.outside.get(i, 0) === 1;
  }

  /** The index of the first pose in the frame that a robot's poses have at a time. */
  firstInFrame(robot, time) {
    const i = robot.frames.at(time);
    return i < 0 ? 0 : upTo(robot.pose.t, robot.frames.t[i] - 1e-6);
  }

  /** Rows of what a robot has measured within the last second: [first, end). */
  seenAt(robot, time) { return [upTo(robot.seen.t, time - 1), upTo(robot.seen.t, time)]; }

  /** The place of an event: of its robot or the first one that it names, else of a landmark of its map; null: none. */
  placeOf(event) {
    const words = [event.n.replace('robot/', ''), ...event.x.split(/[^\w]+/)];
    const robot = this.robots.get(words.find((word) => this.robots.has(word)));
    const i = robot ? this.poseAt(robot, event.t) : -1;
    if (i >= 0) return [robot.pose.get(i, 0), robot.pose.get(i, 1)];
    const map = this.mapAt(event.t), named = PLACED.exec(event.x);
    const k = map && named ? map.ids.indexOf(Number(named[1])) : -1;
    return k < 0 ? null : [map.xy[2 * k], map.xy[2 * k + 1]];
  }

  stateAt(robot, time) {
    const i = upTo(robot.stateTimes, time) - 1;
    return i < 0 ? '' : robot.states[i];
  }

  figuresAt(node, time) {
    const found = this.figures.get(node);
    if (!found) return null;
    const i = upTo(found.t, time) - 1;
    return i < 0 ? null : found.f[i];
  }
}
