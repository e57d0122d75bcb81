// Plots over team time: lines, a band, levels, and where the time is.

export class Plot {
  constructor(canvas, onSeek) {
    this.canvas = canvas;
    this.base = new OffscreenCanvas(1, 1);
    this.key = '';
    canvas.addEventListener('pointerdown', (event) => {
      const { left, width } = this.frame || { left: 0, width: canvas.clientWidth };
      const share = (event.offsetX - left) / width;
      onSeek(Math.min(Math.max(share, 0), 1) * (this.end || 0));
    });
  }

  /**
   * lines: {colour, width, count, t(i), v(i), alpha}; band: {count, t(i), v(i)} is drawn as ±v.
   * levels: {v, colour, dash}. span: least half height about `about`.
   */
  draw({ key, title, unit, end, time, lines, band, levels, low, high }) {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const w = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const h = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.clientWidth === 0) return;
    this.end = end;
    if (this.canvas.width !== w || this.canvas.height !== h) {
      this.canvas.width = this.base.width = w;
      this.canvas.height = this.base.height = h;
      this.key = '';
    }
    const frame = { left: 40 * ratio, right: w - 4 * ratio, top: 15 * ratio, bottom: h - 4 * ratio };
    this.frame = { left: frame.left / ratio, width: (frame.right - frame.left) / ratio };
    const x = (t) => frame.left + (t / Math.max(end, 1e-9)) * (frame.right - frame.left);
    const full = `${key}|${end}|${w}|${h}`;
    if (this.key !== full) {
      this.key = full;
      this.paint({ title, unit, end, lines, band, levels, low, high, ratio, frame, x });
    }
    const g = this.canvas.getContext('2d');
    g.clearRect(0, 0, w, h);
    g.drawImage(this.base, 0, 0);
    g.fillStyle = colour('text');
    g.globalAlpha = 0.75;
    g.fillRect(Math.round(x(Math.min(time, end))) - ratio / 2, frame.top, ratio, frame.bottom - frame.top);
    g.globalAlpha = 1;
  }

  paint({ title, unit, end, lines, band, levels, low, high, ratio, frame, x }) {
    const g = this.base.getContext('2d');
    g.clearRect(0, 0, this.base.width, this.base.height);
    const y = (v) => frame.bottom - ((v - low) / (high - low)) * (frame.bottom - frame.top);
    g.font = `${10.5 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    g.fillStyle = colour('soft');
    g.textAlign = 'left';
    g.fillText(title, frame.left, 10 * ratio);
    g.textAlign = 'right';
    for (const v of ticks(low, high)) {
      g.fillStyle = colour('soft');
      g.fillText(tickText(v) + (v === 0 ? '' : unit), frame.left - 5 * ratio, y(v) + 3.5 * ratio);
      g.fillStyle = colour('grid-strong');
      g.fillRect(frame.left, Math.round(y(v)), frame.right - frame.left, 1);
    }
    g.save();
    g.beginPath();
    g.rect(frame.left, frame.top, frame.right - frame.left, frame.bottom - frame.top);
    g.clip();
    const step = Math.max(end, 1e-9) / (frame.right - frame.left);  // seconds per pixel
    if (band && band.count) {
      const upper = thinned(band, step);
      g.beginPath();
      upper.forEach(([t, , v], i) => (i ? g.lineTo(x(t), y(v)) : g.moveTo(x(t), y(v))));
      upper.reverse().forEach(([t, , v]) => g.lineTo(x(t), y(-v)));
      g.closePath();
      g.fillStyle = colour('band');
      g.fill();
    }
    for (const level of levels || []) {
      g.strokeStyle = colour(level.colour);
      g.setLineDash([4 * ratio, 4 * ratio]);
      g.lineWidth = ratio;
      g.beginPath();
      g.moveTo(frame.left, y(level.v));
      g.lineTo(frame.right, y(level.v));
      g.stroke();
      g.setLineDash([]);
    }
    for (const line of lines) {
      g.strokeStyle = line.colour;
      g.globalAlpha = line.alpha || 1;
      g.lineWidth = (line.width || 1.4) * ratio;
      g.lineJoin = 'round';
      g.beginPath();
      let begun = false;
      for (const [t, least, most] of thinned(line, step)) {
        if (begun) g.lineTo(x(t), y(least)); else g.moveTo(x(t), y(least));
        if (most !== least) g.lineTo(x(t), y(most));
        begun = true;
      }
      g.stroke();
    }
    g.globalAlpha = 1;
    g.restore();
  }
}

/** [t, least, most] per pixel, so that a peak is never thinned away. */
function thinned(line, step) {
  const found = [];
  let last = -Infinity;
  for (let i = 0; i < line.count; i++) {
    const t = line.t(i), v = line.v(i);
    if (t - last >= step || !found.length) {
      found.push([t, v, v]);
      last = t;
    } else {
      const bin = found[found.length - 1];
      if (v < bin[1]) bin[1] = v;
      if (v > bin[2]) bin[2] = v;
    }
  }
  return found;
}

function ticks(low, high) {
  if (low === -high) {  // an error's: nothing, and the largest round number that has room
    const power = 10 ** Math.floor(Math.log10(0.85 * high));
    const v = power * [5, 2, 1].find((s) => s * power <= 0.85 * high);
    return [-v, 0, v];
  }
  const raw = (high - low) / 3, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((s) => s * power >= raw);
  const found = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-12; v += step) found.push(Math.abs(v) < step / 1e6 ? 0 : v);
  return found;
}

function tickText(v) {
  return String(Number(v.toPrecision(3))).replace('-', '−');
}

const cache = new Map();
export function colour(name) {
  if (!name.startsWith('#') && !cache.has(name)) {
    cache.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  }
  return name.startsWith('#') ? name : cache.get(name);
}

matchMedia('(prefers-color-scheme: light)').addEventListener('change', () => cache.clear());
