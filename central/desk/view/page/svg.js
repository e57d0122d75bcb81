// As much of a canvas context as the map needs, written as SVG.

const escaped = (text) => String(text).replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
const short = (v) => Number(v.toFixed(2));

export class SvgContext {
  constructor(width, height) {
    Object.assign(this, {
      width, height, path: '', parts: [], dash: [], globalAlpha: 1, lineWidth: 1, lineJoin: 'miter',
      fillStyle: '#000', strokeStyle: '#000', font: '10px sans-serif', textAlign: 'left',
    });
  }

  text() {
    return `<svg xmlns="http://www.w3.org/2000/svg" width="${this.width}" height="${this.height}" viewBox="0 0 ${this.width} ${this.height}">\n${this.parts.join('\n')}\n</svg>\n`;
  }

  beginPath() { this.path = ''; }
  moveTo(x, y) { this.path += `M${short(x)} ${short(y)}`; }
  lineTo(x, y) { this.path += `L${short(x)} ${short(y)}`; }
  closePath() { this.path += 'Z'; }
  rect(x, y, w, h) { this.path += `M${short(x)} ${short(y)}h${short(w)}v${short(h)}h${short(-w)}Z`; }
  arc(x, y, radius, begin, end) { this.ellipse(x, y, radius, radius, 0, begin, end); }

  /** An arc in two halves, since SVG has none of a whole turn. */
  ellipse(x, y, a, b, turn, begin, end) {
    const c = Math.cos(turn), s = Math.sin(turn);
    const at = (angle) => {
      const u = a * Math.cos(angle), v = b * Math.sin(angle);
      return `${short(x + c * u - s * v)} ${short(y + s * u + c * v)}`;
    };
    const half = `A${short(a)} ${short(b)} ${short((turn * 180) / Math.PI)} 0 1 `;
    this.path += `${this.path.endsWith('Z') || !this.path ? 'M' : 'L'}${at(begin)}${half}${at((begin + end) / 2)}${half}${at(end)}`;
  }

  setLineDash(dash) { this.dash = dash; }
  fill() { this.parts.push(`<path d="${this.path}" fill="${this.fillStyle}" ${this.alpha()}/>`); }
  stroke() { this.parts.push(`<path d="${this.path}" fill="none" ${this.line()}/>`); }

  fillRect(x, y, w, h) {
    this.parts.push(`<rect x="${short(x)}" y="${short(y)}" width="${short(w)}" height="${short(h)}" fill="${this.fillStyle}" ${this.alpha()}/>`);
  }

  fillText(text, x, y) { this.write(text, x, y, `fill="${this.fillStyle}" ${this.alpha()}`); }
  strokeText(text, x, y) { this.write(text, x, y, `fill="none" ${this.line()}`); }

  write(text, x, y, paint) {
    const anchor = this.textAlign === 'center' ? ' text-anchor="middle"' : '';
    this.parts.push(`<text x="${short(x)}" y="${short(y)}" style='font: ${this.font}'${anchor} ${paint}>${escaped(text)}</text>`);
  }

  alpha() { return this.globalAlpha < 1 ? `opacity="${this.globalAlpha}"` : ''; }

  line() {
    const dash = this.dash.length ? ` stroke-dasharray="${this.dash.join(' ')}"` : '';
    return `stroke="${this.strokeStyle}" stroke-width="${short(this.lineWidth)}" stroke-linejoin="${this.lineJoin}"${dash} ${this.alpha()}`;
  }
}
