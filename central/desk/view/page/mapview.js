// The map: landmarks with ellipses, robots, paths, truth. The still parts are painted once into
// layers of their own; while time goes on, only what has been added to a path is painted.

import { upTo } from './store.js';
import { SvgContext } from './svg.js';

const ELLIPSE = Math.sqrt(5.991);  // 95 % of a Gaussian in the plane
const UNNAMED = 2 ** 31;           // from here on the map has numbered landmarks itself: a click says who they are
const LABELS = 400;                // more landmarks than these have no numbers until they are near

export const LAYERS = [
  ['ellipses', '95 % ellipses'], ['labels', 'numbers'], ['changes', 'changes'], ['paths', 'online paths'], ['smoothed', 'smoothed paths'],
  ['truth', 'truth'], ['seen', 'measurements'], ['view', 'field of view'], ['links', 'messages'],
  ['events', 'events'], ['particles', 'particles'],
];
export const MARKS = {  // colour of an event on the map and above the slider
  lost: 'bad', refused: 'bad', withdrawn: 'bad', warning: 'warn', map: 'good', joined: 'good',
  closure: 'good', undone: 'warn', restarted: 'warn',
};
export const CHANGES = { moved: 'warn', gone: 'bad', new: 'good' };  // colour of a landmark against the saved maps
const NEAR = [[1, 1], [1, 0], [1, -1], [-1, 1], [-1, 0], [-1, -1], [0, 1.4], [0, -1.4]];
const SIDES = [...NEAR, ...NEAR.map(([across, down]) => [2 * across, 2 * down])];  // of a name at its robot: right, down; the nearest first
const PULSE_S = 0.8;               // of a message on its way, in seconds of the viewer

export class MapView {
  constructor(canvas, store) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.store = store;
    this.on = Object.fromEntries(LAYERS.map(([name]) => [name, name !== 'view']));
    this.scale = 20;             // pixels per metre
    this.centre = [0, 0];        // metres
    this.fitted = true;          // until somebody moves the map
    this.follow = null;          // a robot's name
    this.chosen = null;
    this.pace = 1;               // seconds of the team per second of the viewer
    this.landmarks = new OffscreenCanvas(1, 1);
    this.paths = new OffscreenCanvas(1, 1);
    this.painted = {};           // what the layers hold
    this.paintedAt = this.movedAt = -1e9;
    this.cost = 0;               // of painting them [ms]
    this.pending = false;
    this.frames = 0;
    this.sides = new Map();      // of the robots' names, by robot
    this.names = [];             // their boxes
    this.readColours();
    this.listen();
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    const of = (name) => style.getPropertyValue(`--${name}`).trim();
    this.colours = {
      ground: of('ground'), grid: of('grid'), strong: of('grid-strong'), landmark: of('landmark'),
      truth: of('truth'), text: of('text'), soft: of('soft'), good: of('good'), warn: of('warn'), bad: of('bad'),
    };
    this.painted = {};
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      for (const each of [this.canvas, this.landmarks, this.paths]) {
        each.width = width;
        each.height = height;
      }
      this.painted = {};
    }
    this.ratio = ratio;
  }

  fit() {
    const [left, bottom, right, top] = this.store.extent();
    if (!(right >= left)) return;
    const width = Math.max(right - left, 1), height = Math.max(top - bottom, 1);
    this.resize();
    const w = this.canvas.width / this.ratio, h = this.canvas.height / this.ratio;
    const room = 34, above = Math.max(46, document.querySelector('.chips').offsetHeight + 12);
    const beside = document.querySelector('.tools').offsetWidth;
    this.scale = Math.min((w - beside - 2 * room) / width, (h - above - 2 * room) / height, 400);
    this.centre = [
      (left + right) / 2 + beside / 2 / this.scale, (bottom + top) / 2 + above / 2 / this.scale,
    ];
    this.fitted = true;
  }

  screen(x, y) {
    return [
      (x - this.centre[0]) * this.scale * this.ratio + this.canvas.width / 2,
      (this.centre[1] - y) * this.scale * this.ratio + this.canvas.height / 2,
    ];
  }

  /** Move the map so that a place is on the screen, if it is not. */
  show(x, y) {
    const [u, v] = this.screen(x, y);
    if (u > 0 && v > 0 && u < this.canvas.width && v < this.canvas.height) return;
    this.centre = [x, y];
    this.fitted = false;
  }

  zoom(factor, at = null) {
    const w = this.canvas.clientWidth / 2, h = this.canvas.clientHeight / 2;
    const [px, py] = at || [w, h];
    const x = this.centre[0] + (px - w) / this.scale, y = this.centre[1] - (py - h) / this.scale;
    this.scale = Math.min(Math.max(this.scale * factor, 0.05), 5000);
    this.centre = [x - (px - w) / this.scale, y + (py - h) / this.scale];
    this.fitted = false;
  }

  listen() {
    const fingers = new Map();
    let distance = 0;
    const canvas = this.canvas;
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015), [event.offsetX, event.offsetY]);
    }, { passive: false });
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
      distance = 0;
    });
    canvas.addEventListener('pointermove', (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) {
        if (this.onHover) this.onHover(event.offsetX * this.ratio, event.offsetY * this.ratio);
        return;
      }
      const now = [event.offsetX, event.offsetY];
      fingers.set(event.pointerId, now);
      this.centre = [
        this.centre[0] - (now[0] - before[0]) / this.scale / fingers.size,
        this.centre[1] + (now[1] - before[1]) / this.scale / fingers.size,
      ];
      this.fitted = false;
      if (this.follow) this.onMove();
      if (fingers.size === 2) {
        const [a, b] = [...fingers.values()];
        const apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (distance) this.zoom(apart / distance, [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]);
        distance = apart;
      }
    });
    for (const end of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(end, (event) => { fingers.delete(event.pointerId); distance = 0; });
    }
    canvas.addEventListener('click', (event) => {
      if (this.onPick) this.onPick(event.offsetX * this.ratio, event.offsetY * this.ratio);
    });
    canvas.addEventListener('dblclick', () => { this.onMove(); this.fit(); });
  }

  draw(time) {
    this.resize();
    if (this.fitted) this.fit();
    if (this.follow) {
      const robot = this.store.robots.get(this.follow);
      const i = robot ? this.store.poseAt(robot, time) : -1;
      if (i >= 0) { this.centre = [robot.pose.get(i, 0), robot.pose.get(i, 1)]; this.fitted = false; }
    }
    this.paintLayers(time);
    this.blit(this.context);
    this.paintMoving(this.context, time);
    this.frames++;
  }

  /** The text of an SVG file of what is shown. */
  svg(time) {
    const { width, height } = this.canvas, fast = this.fast;
    const g = new SvgContext(width, height);
    this.fast = false;
    this.paintLandmarks(g, this.store.mapAt(time), this.store.truthAt(time));
    this.paintPaths(g, time, new Map());
    this.paintMoving(g, time);
    this.fast = fast;
    return g.text();
  }

  paintMoving(g, time) {
    const robots = [...this.store.robots.values()];
    if (this.on.view) for (const robot of robots) this.paintView(g, robot, time);
    if (this.on.seen) for (const robot of robots) this.paintSeen(g, robot, time);
    if (this.on.particles) this.paintParticles(g, time);
    if (this.on.events) this.paintEvents(g, time);
    for (const robot of robots) this.paintRobot(g, robot, time);
    this.paintNames(g, time);
    if (this.on.links) this.paintLinks(g, time);
  }

  /**
   * Paint the layers where they are not up to date, but not so often that nothing else is done:
   * meanwhile they are shown moved and scaled as they are. `pending`: they are to be painted yet.
   */
  paintLayers(time) {
    const shape = `${this.canvas.width},${this.canvas.height},${Object.values(this.on)}`;
    const view = `${this.centre},${this.scale},${shape}`;
    const now = performance.now();
    const due = now - this.paintedAt > Math.min(8 * this.cost, 700);
    const moved = this.painted.view !== undefined && this.painted.view !== view;
    if (moved && this.movedTo !== view) { this.movedTo = view; this.movedAt = now; }
    const still = now - this.movedAt > 120;
    const stretched = this.painted.scale && (this.scale / this.painted.scale > 2 || this.painted.scale / this.scale > 2);
    const fresh = this.painted.view === undefined || this.painted.shape !== shape;
    this.pending = false;
    if (moved && !fresh && !(due && (still || stretched || this.cost < 8 || now - this.paintedAt > 250))) {
      this.pending = true;
      return;
    }
    const map = this.store.mapAt(time), motion = this.store.truthAt(time);
    const news = this.painted.map !== map || this.painted.trueMap !== this.store.trueMap || this.painted.motion !== motion;
    const began = performance.now();
    this.fast = moved && !still && this.cost > 8;
    if (moved || fresh || this.painted.fast || (news && due)) {
      if (this.painted.fast && !this.fast) this.painted.paths = null;
      this.paintLandmarks(this.landmarks.getContext('2d'), map, motion);
      this.painted = {
        ...this.painted, view, shape, map, motion, trueMap: this.store.trueMap, scale: this.scale, centre: [...this.centre],
        fast: this.fast,
      };
      this.paintedAt = began;
    } else if (news) this.pending = true;
    this.extendPaths(time, view);
    if (this.paintedAt === began) this.cost = performance.now() - began;
    if (this.fast) this.pending = true;
  }

  blit(g) {
    const k = this.scale / this.painted.scale, { width, height } = this.canvas;
    const x = (this.painted.centre[0] - this.centre[0]) * this.scale * this.ratio + (width / 2) * (1 - k);
    const y = (this.centre[1] - this.painted.centre[1]) * this.scale * this.ratio + (height / 2) * (1 - k);
    if (k !== 1 || x || y) {
      g.fillStyle = this.colours.ground;
      g.fillRect(0, 0, width, height);
    }
    g.drawImage(this.landmarks, x, y, k * width, k * height);
    g.drawImage(this.paths, x, y, k * width, k * height);
  }

  paintGrid(g) {
    g.fillStyle = this.colours.ground;
    g.fillRect(0, 0, this.canvas.width, this.canvas.height);
    const metres = gridStep(this.scale);
    const step = metres * this.scale * this.ratio;
    const [ox, oy] = this.screen(0, 0);
    for (const [offset, size, vertical] of [[ox, this.canvas.width, true], [oy, this.canvas.height, false]]) {
      const first = Math.ceil(-offset / step);
      for (let k = first; offset + k * step < size; k++) {
        const at = Math.round(offset + k * step) + 0.5;
        g.strokeStyle = k % 5 === 0 ? this.colours.strong : this.colours.grid;
        g.lineWidth = 1;
        g.beginPath();
        if (vertical) { g.moveTo(at, 0); g.lineTo(at, this.canvas.height); } else { g.moveTo(0, at); g.lineTo(this.canvas.width, at); }
        g.stroke();
      }
    }
  }

  paintLandmarks(g, map, motion) {
    this.paintGrid(g);
    const r = this.ratio;
    if (this.on.truth && this.store.trueMap && motion) {
      g.strokeStyle = this.colours.truth;
      g.lineWidth = 1.2 * r;
      g.beginPath();
      const { xy } = this.store.trueMap, arm = 4 * r;
      for (let i = 0; i < xy.length; i += 2) {
        const [x, y] = this.screen(...moved(motion, xy[i], xy[i + 1]));
        if (x < -9 || y < -9 || x > this.canvas.width + 9 || y > this.canvas.height + 9) continue;
        g.moveTo(x - arm, y - arm); g.lineTo(x + arm, y + arm);
        g.moveTo(x - arm, y + arm); g.lineTo(x + arm, y - arm);
      }
      g.stroke();
    }
    if (!map) return;
    const count = map.ids.length, k = this.scale * r;
    const seen = [], changes = this.on.changes && map.changes;
    for (let i = 0; i < count; i++) {
      const change = changes && changes.of.get(map.ids[i]);
      if (change && change.state === 'gone') continue;  // it is drawn at its place in the saved map
      const [x, y] = this.screen(map.xy[2 * i], map.xy[2 * i + 1]);
      if (x > -40 && y > -40 && x < this.canvas.width + 40 && y < this.canvas.height + 40) seen.push([x, y, i]);
    }
    if (this.on.ellipses) {
      g.strokeStyle = this.colours.landmark;
      g.fillStyle = this.colours.landmark;
      g.lineWidth = 1.2 * r;
      for (const [x, y, i] of seen) {  // one by one: a path of thousand ellipses takes twice as long
        const [major, minor, turn] = ellipse(map.c[3 * i], map.c[3 * i + 1], map.c[3 * i + 2]);
        g.beginPath();
        g.ellipse(x, y, Math.max(major * k, 2 * r), Math.max(minor * k, 2 * r), -turn, 0, 2 * Math.PI);
        if (!this.fast) { g.globalAlpha = 0.16; g.fill(); }
        const tentative = map.n && map.n[i] === 1;  // one submap alone has it
        g.setLineDash(tentative ? [3 * r, 3 * r] : []);
        g.globalAlpha = tentative ? 0.5 : 0.85; g.stroke();
      }
      g.setLineDash([]);
      g.globalAlpha = 1;
    }
    g.fillStyle = this.colours.landmark;
    const dot = (count > 300 ? 1.8 : 2.6) * r;
    for (const [x, y] of seen) {
      if (count > 300) { g.fillRect(x - dot, y - dot, 2 * dot, 2 * dot); continue; }
      g.beginPath();
      g.arc(x, y, dot, 0, 2 * Math.PI);
      g.fill();
    }
    if (this.on.labels && seen.length <= LABELS) {
      g.font = this.font(11);
      g.fillStyle = this.colours.soft;
      for (const [x, y, i] of seen) if (map.ids[i] < UNNAMED) g.fillText(map.ids[i], x + 6 * r, y - 5 * r);
    }
    if (changes) this.paintChanges(g, changes);
  }

  /**
   * Landmarks that are not as the saved maps have them: of a moved one an arrow from its old place,
   * of one that is gone a hollow mark there, around a new one a square.
   */
  paintChanges(g, changes) {
    const r = this.ratio;
    g.font = this.font(11);
    for (const { landmark, state, x, y, dx, dy } of changes.rows) {
      const [u, v] = this.screen(x, y), [p, q] = this.screen(x + dx, y + dy);
      g.strokeStyle = g.fillStyle = this.colours[CHANGES[state]];
      g.lineWidth = 1.6 * r;
      if (state === 'new') {
        g.beginPath(); g.rect(u - 6 * r, v - 6 * r, 12 * r, 12 * r); g.stroke();
        continue;
      }
      g.setLineDash(state === 'gone' ? [3 * r, 2.5 * r] : []);
      g.beginPath(); g.arc(u, v, (state === 'gone' ? 6 : 4) * r, 0, 2 * Math.PI); g.stroke();
      g.setLineDash([]);
      if (state === 'gone') {
        if (this.on.labels && landmark < UNNAMED) g.fillText(landmark, u + 8 * r, v - 5 * r);
        continue;
      }
      const ring = 7 * r, long = Math.hypot(p - u, q - v) - ring, turn = Math.atan2(q - v, p - u);
      g.beginPath(); g.arc(p, q, ring, 0, 2 * Math.PI); g.stroke();
      if (long <= 0) continue;  // the ring covers both places
      const head = Math.min(9 * r, long), tip = [p - ring * Math.cos(turn), q - ring * Math.sin(turn)];
      g.beginPath(); g.moveTo(u, v); g.lineTo(...tip); g.stroke();
      g.beginPath();
      g.moveTo(...tip);
      for (const side of [-0.45, 0.45]) g.lineTo(tip[0] - head * Math.cos(turn + side), tip[1] - head * Math.sin(turn + side));
      g.closePath(); g.fill();
    }
  }

  font(size) { return `${size * this.ratio}px system-ui, "DejaVu Sans", sans-serif`; }

  // The landmark of a map that is drawn within 12 pixels of a place on the screen, also its place in the saved map; -1: there is none.
  landmarkAt(map, x, y) {
    let best = -1, least = 12 * this.ratio;
    const take = (i, place) => {
      const [u, v] = this.screen(...place), away = Math.hypot(u - x, v - y);
      if (away < least) { best = i; least = away; }
    };
    for (let i = 0; map && i < map.ids.length; i++) {
      const change = this.on.changes && map.changes && map.changes.of.get(map.ids[i]);
      if (change) take(i, [change.x, change.y]);
      if (!change || change.state !== 'gone') take(i, [map.xy[2 * i], map.xy[2 * i + 1]]);
    }
    return best;
  }

  extendPaths(time, view) {
    const g = this.paths.getContext('2d');
    const inside = [...this.store.robots.values()].filter((robot) => !this.store.isOutside(robot, time));
    const shown = `${this.store.truthAt(time)} ${inside.map((robot) => `${robot.name} ${this.store.firstInFrame(robot, time)}`)}`;
    const sameView = this.painted.paths === view && time >= this.painted.time && this.painted.store === this.store.hello && this.painted.shown === shown;
    if (!sameView) {
      g.clearRect(0, 0, this.canvas.width, this.canvas.height);
      this.painted.ends = new Map();
    }
    this.painted.paths = view;
    this.painted.shown = shown;
    this.painted.time = time;
    this.painted.store = this.store.hello;
    this.paintPaths(g, time, this.painted.ends);
  }

  /** Paint what `ends` lacks of the paths until a time; it gets how far each is painted. */
  paintPaths(g, time, ends) {
    const r = this.ratio, motion = this.store.truthAt(time);
    g.lineJoin = 'bevel';
    for (const robot of this.store.robots.values()) {
      if (this.on.truth && motion) this.extendPath(g, ends, `truth ${robot.name}`, robot.truth, time, this.colours.truth, 1 * r, 0.55, 0, motion);
      const smoothed = this.on.smoothed && robot.smoothed.length, beside = smoothed && !robot.atEnds;
      if (beside) this.extendPath(g, ends, `smoothed ${robot.name}`, robot.smoothed, time, robot.colour, 2.2 * r, 0.95);
      // Poses from before a robot was in the team's frame are in its own frame.
      if (this.on.paths && !this.store.isOutside(robot, time)) {
        this.extendPath(g, ends, `pose ${robot.name}`, robot.pose, time, robot.colour, (beside ? 1 : 2) * r, beside ? 0.5 : 0.75, this.store.firstInFrame(robot, time));
      }
      if (smoothed && robot.atEnds) this.paintEnds(g, ends, `smoothed ${robot.name}`, robot.smoothed, time, robot.colour);
    }
  }

  /** Smoothed poses at the ends of submaps: between them the path is not a chord. */
  paintEnds(g, ends, key, series, time, colour) {
    const to = series.at(time);
    g.fillStyle = colour;
    for (let i = ends.get(key) || 0; i <= to; i++) {
      const [x, y] = this.screen(series.get(i, 0), series.get(i, 1));
      g.beginPath(); g.arc(x, y, 3.2 * this.ratio, 0, 2 * Math.PI); g.fill();
    }
    ends.set(key, to + 1);
  }

  extendPath(g, ends, key, series, time, colour, width, alpha, first = 0, motion = null) {
    const from = Math.max(first, ends.get(key) || 0);
    const to = series.at(time);
    if (to <= from) return;
    g.strokeStyle = colour;
    g.lineWidth = this.fast ? 1 : width;
    g.globalAlpha = alpha;
    g.beginPath();
    let drawn = 0;
    const at = (i) => {
      const place = [series.get(i, 0), series.get(i, 1)];
      return this.screen(...(motion ? moved(motion, ...place) : place));
    };
    let [x, y] = at(from);
    g.moveTo(x, y);
    for (let i = from + 1; i <= to; i++) {
      const [nx, ny] = at(i);
      if (i < to && Math.abs(nx - x) + Math.abs(ny - y) < 1.5) continue;  // nobody could see it
      if (Math.hypot(nx - x, ny - y) > 2.5 * this.scale * this.ratio + 400) g.moveTo(nx, ny); else g.lineTo(nx, ny);
      [x, y] = [nx, ny];
      if (++drawn % 30 === 0 && !g.text) { g.stroke(); g.beginPath(); g.moveTo(x, y); }  // short ones are faster
    }
    g.stroke();
    g.globalAlpha = 1;
    ends.set(key, to);
  }

  /** [x, y, heading] of a robot at a time; null where it has no place in the team's frame. */
  placeAt(robot, time) {
    const i = robot ? this.store.poseAt(robot, time) : -1;
    return i < 0 ? null : between(robot.pose, i, time);
  }

  /** The sector in which a robot's sensor measures; without a stated range, as far as it has measured. */
  paintView(g, robot, time) {
    const place = this.placeAt(robot, time);
    if (!place || !robot.reach) return;
    const { mount, range, view } = robot.sensor || { mount: [0, 0, 0], range: Infinity, view: 2 * Math.PI };
    const [x, y] = this.screen(...moved(place, mount[0], mount[1]));
    const radius = Math.min(range, robot.reach) * this.scale * this.ratio;
    const axis = -(place[2] + mount[2]), half = Math.min(view, 2 * Math.PI) / 2;
    g.beginPath();
    if (half < Math.PI) g.moveTo(x, y);
    g.arc(x, y, radius, axis - half, axis + half);
    g.closePath();
    g.fillStyle = g.strokeStyle = robot.colour;
    g.lineWidth = this.ratio;
    g.globalAlpha = 0.06; g.fill();
    g.globalAlpha = 0.35; g.stroke();
    g.globalAlpha = 1;
  }

  /** Rays to the landmarks and teammates that a robot measures; dashed to a place that is not in the map. */
  paintSeen(g, robot, time) {
    const place = this.placeAt(robot, time), [first, end] = this.store.seenAt(robot, time);
    if (!place || end <= first) return;
    const map = this.store.mapAt(time), r = this.ratio, rays = new Map();
    for (let i = first; i < end; i++) {
      const name = robot.seen.get(i, 0);
      rays.set(name === -1 ? `${name} ${i}` : name, i);
    }
    const [x, y] = this.screen(place[0], place[1]);
    g.strokeStyle = robot.colour;
    for (const [name, i] of rays) {
      const k = map && typeof name === 'number' ? map.ids.indexOf(name) : -1;
      const mate = typeof name === 'string' ? this.placeAt(this.store.robots.get(name), time) : null;
      const known = k >= 0 ? [map.xy[2 * k], map.xy[2 * k + 1]] : mate;
      const [u, v] = this.screen(...(known || moved(place, robot.seen.get(i, 1), robot.seen.get(i, 2))));
      g.globalAlpha = mate ? 0.9 : 0.55;
      g.lineWidth = (mate ? 2.2 : 1) * r;
      g.setLineDash(known ? [] : [4 * r, 4 * r]);
      g.beginPath(); g.moveTo(x, y); g.lineTo(u, v); g.stroke();
      g.beginPath(); g.arc(u, v, (mate ? 8 : 5) * r, 0, 2 * Math.PI); g.stroke();
    }
    g.setLineDash([]);
    g.globalAlpha = 1;
  }

  /** The centre has no place in the map: it is shown in the corner, where links end. */
  hub() { return [this.canvas.width - 46 * this.ratio, this.canvas.height - 40 * this.ratio]; }

  /** Pulses on links: a submap leaves in its robot's colour, a map comes back in that of landmarks. */
  paintLinks(g, time) {
    const r = this.ratio, lasts = PULSE_S * this.pace;
    const at = (name) => {
      if (name === 'central') return this.hub();
      const place = this.placeAt(this.store.robots.get(name), time);
      return place && this.screen(place[0], place[1]);
    };
    if (this.store.hasCentre) this.paintHub(g);
    const { links, linkTimes } = this.store;
    for (let i = upTo(linkTimes, time - lasts); i < links.length && links[i].t <= time; i++) {
      const { t, from, to } = links[i];
      const a = at(from), b = to === 'central' && !this.store.hasCentre ? null : at(to);
      if (!a || !b) continue;
      const share = (time - t) / lasts, x = a[0] + share * (b[0] - a[0]), y = a[1] + share * (b[1] - a[1]);
      const back = from === 'central';
      g.strokeStyle = g.fillStyle = back ? this.colours.landmark : this.store.robots.get(from).colour;
      g.globalAlpha = 0.3; g.lineWidth = 1.2 * r;
      g.beginPath(); g.moveTo(...a); g.lineTo(...b); g.stroke();
      g.globalAlpha = 1;
      g.beginPath(); g.arc(x, y, 4.5 * r, 0, 2 * Math.PI);
      if (back) g.stroke(); else g.fill();
    }
    g.globalAlpha = 1;
  }

  paintHub(g) {
    const r = this.ratio, [x, y] = this.hub();
    g.fillStyle = this.colours.ground;
    g.strokeStyle = this.colours.soft;
    g.lineWidth = 1.5 * r;
    g.beginPath(); g.rect(x - 9 * r, y - 9 * r, 18 * r, 18 * r); g.fill(); g.stroke();
    g.font = this.font(11);
    g.fillStyle = this.colours.soft;
    g.textAlign = 'center';
    g.fillText('centre', x, y + 22 * r);
    g.textAlign = 'left';
  }

  paintEvents(g, time) {
    const r = this.ratio;
    this.marks = [];  // for clicks: x, y, event
    for (const event of this.store.events) {
      if (event.t > time + 1e-6) break;
      if (!MARKS[event.e] || event.e === 'joined') continue;
      if (!event.place && event.version !== this.store.version) {
        event.version = this.store.version;  // poses may come after their event
        event.place = this.store.placeOf(event);
      }
      if (!event.place) continue;
      const [x, y] = this.screen(...event.place), size = 6 * r;
      this.marks.push([x, y, event]);
      g.beginPath();
      g.moveTo(x, y - size); g.lineTo(x + size, y); g.lineTo(x, y + size); g.lineTo(x - size, y);
      g.closePath();
      g.fillStyle = this.colours[MARKS[event.e]];
      g.strokeStyle = this.colours.ground;
      g.lineWidth = 1.5 * r;
      g.fill(); g.stroke();
    }
  }

  /** The events that are marked within 12 pixels of a place on the screen. */
  eventsAt(x, y) {
    return (this.on.events && this.marks || []).filter(([u, v]) => Math.hypot(u - x, v - y) < 12 * this.ratio).map(([, , event]) => event);
  }

  paintParticles(g, time) {
    const r = this.ratio;
    for (const robot of this.store.robots.values()) {
      const i = upTo(robot.cloudTimes, time) - 1;
      if (i < 0 || time - robot.cloudTimes[i] > 30) continue;
      const points = robot.clouds[i], at = this.store.poseAt(robot, time);
      if (at < 0) continue;
      const place = between(robot.pose, at, time);
      g.fillStyle = robot.colour;
      g.globalAlpha = 0.5;
      g.beginPath();
      for (let k = 0; k < points.length; k += 2) {
        const [x, y] = this.screen(...moved(place, points[k], points[k + 1]));
        g.rect(x - r, y - r, 2 * r, 2 * r);
      }
      g.fill();
      g.globalAlpha = 1;
    }
  }

  paintRobot(g, robot, time) {
    const r = this.ratio;
    const motion = this.on.truth && this.store.truthAt(time);
    if (motion) {
      const i = robot.truth.at(time);
      if (i >= 0) {
        const place = between(robot.truth, i, time);
        const [x, y] = this.screen(...moved(motion, place[0], place[1]));
        this.arrow(g, x, y, place[2] + motion[2], 9 * r);
        g.strokeStyle = this.colours.truth;
        g.lineWidth = 1.3 * r;
        g.stroke();
      }
    }
    const i = this.store.poseAt(robot, time);
    if (i < 0) return;
    const [px, py, heading] = between(robot.pose, i, time);
    const [x, y] = this.screen(px, py);
    const lost = this.store.stateAt(robot, time) === 'lost';
    const [major, minor, turn] = ellipse(robot.pose.get(i, 3), robot.pose.get(i, 4), robot.pose.get(i, 5));
    const k = this.scale * r;
    g.beginPath();
    g.ellipse(x, y, Math.max(major * k, r), Math.max(minor * k, r), -turn, 0, 2 * Math.PI);
    g.fillStyle = g.strokeStyle = robot.colour;
    g.globalAlpha = 0.18; g.fill();
    g.globalAlpha = 0.8; g.lineWidth = 1.2 * r; g.stroke();
    g.globalAlpha = lost ? 0.4 : 1;
    if (robot.name === this.chosen) {
      g.beginPath(); g.arc(x, y, 17 * r, 0, 2 * Math.PI); g.lineWidth = 1.5 * r; g.stroke();
    }
    this.arrow(g, x, y, heading, 11 * r);
    g.fill();
    g.lineWidth = 1.5 * r;
    g.strokeStyle = this.colours.ground;
    g.stroke();
    g.globalAlpha = 1;
  }

  /** Names beside the robots, where they cover no number, landmark, robot or other name. */
  paintNames(g, time) {
    const r = this.ratio, font = `600 ${this.font(12)}`;
    this.context.font = font;
    const robots = [...this.store.robots.values()].flatMap((robot) => {
      const place = this.placeAt(robot, time);
      if (!place) return [];
      const [x, y] = this.screen(place[0], place[1]);
      const isLost = this.store.stateAt(robot, time) === 'lost';
      const text = isLost ? `${robot.name} lost` : robot.name;
      return [{ robot, x, y, text, isLost, width: this.context.measureText(text).width }];
    });
    const taken = [...robots.map(({ x, y }) => box(x, y, 12 * r, 12 * r)), ...this.landmarkBoxes(this.store.mapAt(time))];
    this.names = [];
    for (const { robot, x, y, text, isLost, width } of robots) {
      const w = width / 2 + 2 * r, reach = [2 * w + 28 * r, 52 * r];
      const near = taken.filter((each) => overlap(each, box(x, y, ...reach)));
      let best = null, least = Infinity;
      const before = this.sides.get(robot.name);
      const stays = before < NEAR.length ? [before] : [];  // a name stays near where it can
      for (const side of [...stays, ...SIDES.keys()]) {
        const [across, down] = SIDES[side];
        const at = box(x + Math.sign(across) * w + across * 13 * r, y + down * 15 * r, w, 7 * r);
        const covered = near.reduce((sum, each) => sum + overlap(at, each), 0);
        if (covered < least) { best = { at, side }; least = covered; }
        if (!covered) break;
      }
      this.sides.set(robot.name, best.side);
      this.names.push(best.at);
      taken.push(best.at);
      g.font = font;
      g.globalAlpha = isLost ? 0.4 : 1;
      g.strokeStyle = this.colours.ground;
      g.fillStyle = robot.colour;
      g.lineWidth = 3.5 * r;
      const [left, , , bottom] = best.at;
      g.strokeText(text, left + 2 * r, bottom - 3 * r);
      g.fillText(text, left + 2 * r, bottom - 3 * r);
      g.globalAlpha = 1;
    }
  }

  /** Boxes [left, top, right, bottom] of landmarks and of their numbers; none where numbers are not shown for their number. */
  landmarkBoxes(map) {
    const r = this.ratio, boxes = [];
    let shown = 0;
    for (let i = 0; map && i < map.ids.length; i++) {
      const [x, y] = this.screen(map.xy[2 * i], map.xy[2 * i + 1]);
      if (x < -40 || y < -40 || x > this.canvas.width + 40 || y > this.canvas.height + 40) continue;
      if (++shown > LABELS) return [];
      boxes.push(box(x, y, 3 * r, 3 * r));
      if (this.on.labels && map.ids[i] < UNNAMED) {
        boxes.push([x + 6 * r, y - 14 * r, x + (6 + 7 * String(map.ids[i]).length) * r, y - 4 * r]);
      }
    }
    return boxes;
  }

  arrow(g, x, y, heading, size) {
    const at = (turn, length) => [x + length * Math.cos(heading + turn), y - length * Math.sin(heading + turn)];
    g.beginPath();
    g.moveTo(...at(0, 1.15 * size));
    g.lineTo(...at(2.5, size));
    g.lineTo(...at(Math.PI, 0.45 * size));
    g.lineTo(...at(-2.5, size));
    g.closePath();
  }
}

/** [left, top, right, bottom] of a box by its middle and half sizes. */
function box(x, y, w, h) { return [x - w, y - h, x + w, y + h]; }

/** The area that two boxes have in common. */
function overlap(a, b) {
  return Math.max(0, Math.min(a[2], b[2]) - Math.max(a[0], b[0])) * Math.max(0, Math.min(a[3], b[3]) - Math.max(a[1], b[1]));
}

/** The place that is so far ahead and left of a pose. */
function moved([x, y, heading], ahead, left) {
  const c = Math.cos(heading), s = Math.sin(heading);
  return [x + c * ahead - s * left, y + s * ahead + c * left];
}

/** Half axes of the 95 % ellipse [m] and the direction of the major one [rad]. */
export function ellipse(xx, xy, yy) {
  const middle = (xx + yy) / 2, half = (xx - yy) / 2, root = Math.hypot(half, xy);
  return [ELLIPSE * Math.sqrt(middle + root), ELLIPSE * Math.sqrt(Math.max(middle - root, 0)), Math.atan2(xy, half) / 2];
}

/** The pose between entry i and the next, straight and along the shorter arc; over gaps, entry i. */
function between(series, i, time) {
  const pose = [series.get(i, 0), series.get(i, 1), series.get(i, 2)];
  if (i + 1 >= series.length) return pose;
  const gap = series.t[i + 1] - series.t[i];
  if (!(gap > 0 && gap < 2.5)) return pose;
  const share = (time - series.t[i]) / gap;
  const turn = series.get(i + 1, 2) - pose[2];
  return [
    pose[0] + share * (series.get(i + 1, 0) - pose[0]),
    pose[1] + share * (series.get(i + 1, 1) - pose[1]),
    pose[2] + share * Math.atan2(Math.sin(turn), Math.cos(turn)),
  ];
}

/** Metres between two lines of the grid: 1, 2 or 5 times a power of ten, some 40 pixels or more. */
export function gridStep(scale) {
  const least = 34 / scale, power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((step) => step * power >= least);
}
