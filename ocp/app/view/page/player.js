// The player: the data of the page, the time shown, and the motions shown: one alone, two superimposed or side by side.

const COLORS = {plan: [0, 0.447, 0.698], other: [0.835, 0.369, 0], target: [0, 0.62, 0.451], near: [0.8, 0.475, 0.655],
  solid: [0.43, 0.43, 0.43, 0.55], grid: [0.5, 0.5, 0.5, 0.28]};
const AXES = [[0.84, 0.15, 0.16], [0.17, 0.63, 0.17], [0.12, 0.47, 0.71]];
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10];
const GHOSTS = [0, 1 / 3, 2 / 3, 1];
const KINDS = {u2: Uint16Array, u4: Uint32Array, i1: Int8Array, f4: Float32Array};
const element = (name) => document.getElementById(name);

async function unpacked() {
  const text = atob(element("data").textContent.trim());
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const whole = await new Response(stream).arrayBuffer();
  const size = new DataView(whole).getUint32(0, true);
  const data = JSON.parse(new TextDecoder().decode(new Uint8Array(whole, 4, size)));
  const arrays = ({at, kind, shape}) =>
    new KINDS[kind](whole, 4 + size + at, shape.reduce((product, count) => product * count, 1));
  return {data, arrays};
}

class Motion {
  constructor(data, arrays, scene) {
    Object.assign(this, {data, name: data.name, horizon: data.horizon, t: arrays(data.t), poses: arrays(data.poses)});
    this.width = data.poses.shape[1];
    this.time = arrays(data.time);
    this.curves = data.curves.map((one) => ({...one, times: this.time, values: arrays(one.values)}));
    this.around = data.around.map((one) => ({surface: scene.surface(one, arrays), mover: one.mover}));
    this.trace = data.tip ? this.trail(this.width - 1) : new Float32Array(0);
    this.done = scene.line(this.trace);
    this.targets = data.targets.map((one) => {
      const t = arrays(one.t), position = arrays(one.position), rotation = arrays(one.rotation), lines = [];
      for (let k = 0; k + 1 < t.length; k++) {
        const pair = position.subarray(3 * k, 3 * k + 6);
        if (pair.every(Number.isFinite)) lines.push(...pair);
      }
      return {t, position, rotation, line: scene.line(new Float32Array(lines))};
    });
    if (data.near) this.near = {t: arrays(data.near.t), points: arrays(data.near.points),
      distances: arrays(data.near.distances), bodies: data.near.bodies, which: data.near.which,
      line: scene.line(new Float32Array(6), true)};
    if (data.footing) this.footing = {corners: data.footing.corners, forces: data.footing.forces, points: arrays(data.footing.points),
      times: this.time, line: scene.line(this.outline(data.footing.corners))};
    this.pose = new Float32Array(7 * this.width);
  }

  trail(column) {
    const count = this.t.length, segments = new Float32Array(6 * Math.max(count - 1, 0));
    for (let k = 0; k + 1 < count; k++) for (let i = 0; i < 3; i++) {
      segments[6 * k + i] = this.poses[7 * (k * this.width + column) + i];
      segments[6 * k + 3 + i] = this.poses[7 * ((k + 1) * this.width + column) + i];
    }
    return segments;
  }

  outline(corners) {
    return new Float32Array(corners.flatMap(([x, y], k) => [x, y, 0, ...corners[(k + 1) % corners.length], 0]));
  }

  before(times, time) {
    let low = 0, high = times.length - 1;
    while (high - low > 1) { const middle = (low + high) >> 1; if (times[middle] <= time) low = middle; else high = middle; }
    return low;
  }

  at(time) {  // poses of all moving frames, interpolated linearly between the samples
    const k = this.before(this.t, time), size = 7 * this.width;
    const share = Math.max(0, Math.min(1, (time - this.t[k]) / (this.t[k + 1] - this.t[k] || 1)));
    for (let i = 0; i < size; i++)
      this.pose[i] = (1 - share) * this.poses[k * size + i] + share * this.poses[(k + 1) * size + i];
    return this.pose;
  }
}

class Player {
  constructor({data, arrays}) {
    this.data = data;
    this.scene = new Scene(element("scene"));
    this.robots = data.robots.map((robot) => ({...robot, parts: robot.parts.map((part) => ({...part,
      surface: this.scene.surface(part, arrays)}))}));
    this.motions = data.motions.map((one) => new Motion(one, arrays, this.scene));
    this.horizon = Math.max(...this.motions.map((one) => one.horizon));
    this.triad = this.scene.line(new Float32Array([0, 0, 0, 1, 0, 0]));
    Object.assign(this, {time: 0, playing: false, speed: 1, loop: true, mode: "alone", first: 0, second: 1});
    this.shown = {paths: true, frames: true, ghosts: false, near: true, around: true, floor: true};
    if (this.motions.length > 1) this.mode = "over";
    this.frame();
    this.controls();
    this.chart();
    this.table();
    this.scene.changed = () => this.schedule();
    new ResizeObserver(() => this.schedule()).observe(element("scene"));
    this.seek(0);
  }

  frame() {  // aim the camera at everything that is shown
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const take = (point) => point.forEach((value, k) => {
      if (Number.isFinite(value)) { low[k] = Math.min(low[k], value); high[k] = Math.max(high[k], value); }
    });
    const step = (count) => Math.max(1, Math.floor(count / 12));
    for (const motion of this.motions) {
      const robot = this.robots[motion.data.robot], count = motion.t.length;
      for (let k = 0; k < count; k += step(count)) {
        const pose = motion.at(motion.t[k]);
        for (const {mover, surface} of robot.parts) {
          const model = matrixOf(pose, 7 * mover);
          for (let corner = 0; corner < 8; corner++) {
            const p = [0, 1, 2].map((i) => surface.low[i] + (corner >> i & 1) * 65535 * surface.grain[i]);
            take([0, 1, 2].map((i) => model[i] * p[0] + model[4 + i] * p[1] + model[8 + i] * p[2] + model[12 + i]));
          }
        }
      }
      for (const {position} of motion.targets) for (let k = 0; k < position.length; k += 3) take([...position.slice(k, k + 3)]);
      for (let k = 0; k < motion.trace.length; k += 6) take([...motion.trace.slice(k, k + 3)]);
    }
    this.reach = Math.hypot(...high.map((value, k) => value - low[k]));
    this.scene.look(low, high);
    const floats = this.motions.every((one) => one.data.floats), lines = [], middle = low.map((value, k) => (value + high[k]) / 2);
    const cell = 10 ** Math.floor(Math.log10(this.reach / 2)), half = Math.ceil(0.8 * this.reach / cell);
    const [x, y] = middle.map((value) => Math.round(value / cell)), floor = Math.min(low[2], 0) - 1e-3 * this.reach;
    for (let k = -half; k <= half; k++) {
      lines.push((x + k) * cell, (y - half) * cell, floor, (x + k) * cell, (y + half) * cell, floor);
      lines.push((x - half) * cell, (y + k) * cell, floor, (x + half) * cell, (y + k) * cell, floor);
    }
    this.grid = floats ? null : this.scene.line(new Float32Array(lines));
  }

  get visible() {  // the motions that are shown, and the kind of colour of each
    const alone = this.mode === "alone" || this.motions.length < 2;
    const kinds = this.first && (alone || !this.second) ? ["other", "plan"] : ["plan", "other"];
    const shown = [this.first, this.second].map((number, k) => ({motion: this.motions[number], kind: kinds[k]}));
    return alone ? shown.slice(0, 1) : shown;
  }

  schedule() {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.tick(now));
  }

  tick(now) {
    this.scheduled = false;
    if (this.playing) {
      const passed = this.last === undefined ? 0 : Math.min(now - this.last, 250) / 1000;
      this.last = now;
      let time = this.time + this.speed * passed;
      if (time >= this.horizon) {
        if (!this.loop) { time = this.horizon; this.stop(); }
        else time = this.time >= this.horizon ? 0 : this.horizon;
      }
      this.set(time);
    }
    this.draw();
    if (this.playing) this.schedule();
  }

  play() { this.playing = true; this.last = undefined; if (this.time >= this.horizon) this.time = 0; this.button(); this.schedule(); }
  stop() { this.playing = false; this.button(); }
  button() {
    element("play").textContent = this.playing ? "❚❚" : "▶";
    element("play").setAttribute("aria-label", this.playing ? "pause" : "play");
  }

  seek(time) { this.set(Math.max(0, Math.min(this.horizon, time))); this.schedule(); }

  set(time) {
    this.time = time;
    element("scrub").value = time;
    element("clock").textContent = `${time.toFixed(2)} / ${this.horizon.toFixed(2)} s`;
    for (const chart of this.charts || []) if (!chart.hidden()) chart.show(time);
    const {motion} = this.visible[0];
    if (motion.near) {
      const k = motion.before(motion.near.t, time), [one, other] = motion.near.bodies[motion.near.which[k]];
      const distance = valueAt(motion.near.t, motion.near.distances, time);
      element("nearest").textContent = `nearest bodies: ${one} and ${other}, ${(1000 * distance).toFixed(1)} mm`;
    } else element("nearest").textContent = "";
  }

  draw() {
    const {scene, visible} = this, side = this.mode === "side" && visible.length > 1;
    scene.begin();
    for (let k = 0; k < (side ? 2 : 1); k++) {
      scene.part(k, side ? 2 : 1);
      this.drawPart(side ? [visible[k]] : visible);
    }
    element("labels").replaceChildren(...(visible.length > 1 ? visible : []).map(({motion, kind}, k) => {
      const label = document.createElement("span");
      label.className = `ink-${kind}`;
      label.textContent = motion.name;
      label.style.left = side ? `${50 * k}%` : "0";
      if (!side) label.style.top = `${0.5 + 1.4 * k}rem`;
      return label;
    }));
  }

  drawPart(visible) {
    const {scene, shown} = this;
    if (this.grid && shown.floor) scene.drawLine(this.grid, COLORS.grid, 1);
    for (const [number, {motion, kind}] of visible.entries()) {
      const time = Math.min(this.time, motion.horizon), pose = motion.at(time), faint = number > 0;
      if (!faint)
        this.drawRobot(motion, pose, (color) => color);
      if (shown.paths) {
        const upto = this.motions.length ? motion.before(motion.t, time) : 0;
        scene.drawLine(motion.done, [...COLORS[kind], 0.35], 1.6);
        scene.drawLine(motion.done, [...COLORS[kind], 1], 3.4, IDENTITY, upto);
        if (!faint) for (const target of motion.targets) scene.drawLine(target.line, [...COLORS.target, 0.9], 1.8);
      }
      if (shown.frames) this.drawFrames(motion, pose, time);
      if (motion.footing) scene.drawLine(motion.footing.line, [0.4, 0.4, 0.4, 1], 2);
      if (motion.footing) this.drawPush(motion, time, COLORS[kind]);
      if (shown.near && motion.near && !faint) this.drawNear(motion.near, time);
    }
    for (const {motion, kind} of visible.slice(1)) {  // the compared motion, transparent over the first
      const pose = motion.at(Math.min(this.time, motion.horizon));
      scene.drawFaint(() => this.drawRobot(motion, pose, (color) => [...this.tinted(color, COLORS[kind]).slice(0, 3), 0.45]));
    }
    for (const {motion} of visible.slice(0, 1)) this.drawGlass(motion, motion.at(Math.min(this.time, motion.horizon)));
    if (shown.around) scene.drawFaint(() => {
      for (const {motion} of visible.slice(0, 1)) {
        const pose = motion.at(Math.min(this.time, motion.horizon));
        for (const {surface, mover} of motion.around)
          scene.drawSurface(surface, mover === null ? IDENTITY : matrixOf(pose, 7 * mover), COLORS.solid);
      }
    });
    if (shown.ghosts) for (const {motion, kind} of visible) for (const share of GHOSTS) {
      const pose = motion.at(share * motion.horizon);
      scene.drawFaint(() => this.drawRobot(motion, pose, () => [...COLORS[kind], 0.2]));
    }
  }

  drawRobot(motion, pose, paint) {
    const {parts} = this.robots[motion.data.robot];
    for (const {mover, surface, color} of parts.filter((one) => one.color[3] > 0.99))
      this.scene.drawSurface(surface, matrixOf(pose, 7 * mover), paint(color));
  }

  drawGlass(motion, pose) {
    const glass = this.robots[motion.data.robot].parts.filter((one) => one.color[3] <= 0.99);
    if (glass.length) this.scene.drawFaint(() => {
      for (const {mover, surface, color} of glass) this.scene.drawSurface(surface, matrixOf(pose, 7 * mover), color);
    });
  }

  tinted([red, green, blue, opacity], tint) {
    const light = 0.35 + 0.65 * (0.3 * red + 0.59 * green + 0.11 * blue);
    return [...tint.map((value, k) => 0.25 * [red, green, blue][k] + 0.75 * light * (0.25 + 0.75 * value)), opacity];
  }

  drawFrames(motion, pose, time) {
    const length = 0.055 * this.reach;
    if (motion.data.tip) this.drawTriad(matrixOf(pose, 7 * (motion.width - 1)), length, 2.6, 1);
    for (const {t, position, rotation} of motion.targets) {
      const k = Math.min(motion.before(t, time) + 1, t.length - 1);
      const place = [...position.slice(3 * k, 3 * k + 3)], turn = rotation.slice(9 * k, 9 * k + 9);
      if (!place.every(Number.isFinite)) continue;
      const model = new Float32Array([turn[0], turn[3], turn[6], 0, turn[1], turn[4], turn[7], 0, turn[2], turn[5],
        turn[8], 0, ...place, 1]);
      this.drawTriad(model, 1.5 * length, 1.6, 0.8);
    }
  }

  drawTriad(model, length, width, opacity) {
    AXES.forEach((color, k) => {
      const axis = [...model.slice(4 * k, 4 * k + 3)];
      if (!axis.every(Number.isFinite)) return;
      const along = new Float32Array([...axis.map((value) => value * length), 0, 0, 1, 0, 0, 0, 0, 1, 0,
        ...model.slice(12, 15), 1]);
      this.scene.drawLine(this.triad, [...color, opacity], width, along);
    });
  }

  drawNear(near, time) {
    const points = new Float32Array(6), share = valueAt(near.t, near.t.map((_, k) => k), time), k = Math.floor(share);
    const next = Math.min(k + 1, near.t.length - 1), part = near.which[k] === near.which[next] ? share - k : 0;
    for (let i = 0; i < 6; i++) points[i] = (1 - part) * near.points[6 * k + i] + part * near.points[6 * next + i];
    this.scene.refill(near.line, points);
    this.scene.gl.disable(this.scene.gl.DEPTH_TEST);
    this.scene.drawLine(near.line, [...COLORS.near, 1], 3.4);
    this.scene.gl.enable(this.scene.gl.DEPTH_TEST);
  }

  drawPush(motion, time, color) {
    const {points, times} = motion.footing, k = motion.before(times, time), size = 0.02 * this.reach;
    const [x, y] = points.subarray(2 * k, 2 * k + 2);
    for (const [dx, dy] of [[1, 1], [1, -1]])
      this.scene.drawLine(this.triad, [...color, 1], 3,
        new Float32Array([2 * dx * size, 2 * dy * size, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x - dx * size, y - dy * size, 0, 1]));
  }

  controls() {
    const scrub = element("scrub"), speed = element("speed"), options = element("options");
    scrub.max = this.horizon;
    scrub.addEventListener("input", () => { this.stop(); this.seek(+scrub.value); });
    element("play").addEventListener("click", () => this.playing ? this.stop() : this.play());
    speed.append(...SPEEDS.map((one) => new Option(`${one}×`, one, one === 1, one === 1)));
    speed.addEventListener("change", () => { this.speed = +speed.value; });
    element("loop").addEventListener("change", (event) => { this.loop = event.target.checked; });
    document.addEventListener("keydown", (event) => {
      if (/^(INPUT|SELECT|BUTTON|SUMMARY)$/.test(event.target.tagName)) return;
      const step = {ArrowLeft: -0.01, ArrowRight: 0.01}[event.key];
      if (event.key === " ") { event.preventDefault(); this.playing ? this.stop() : this.play(); }
      else if (step) { event.preventDefault(); this.stop(); this.seek(this.time + step * this.horizon); }
    });
    const choice = (label, entries, value, pick) => {
      const field = document.createElement("label"), list = document.createElement("select");
      list.append(...entries.map(([key, text]) => new Option(text, key, key === value, key === value)));
      list.setAttribute("aria-label", label);
      list.addEventListener("change", () => { pick(list.value); this.chart(); this.table(); this.seek(this.time); });
      field.append(`${label} `, list);
      options.append(field);
    };
    if (this.motions.length > 1) {
      const names = this.motions.map((one, k) => [String(k), one.name]);
      choice("plan", names, "0", (value) => { this.first = +value; });
      choice("beside", names, "1", (value) => { this.second = +value; });
      choice("shown", [["alone", "alone"], ["over", "over each other"], ["side", "side by side"]], this.mode,
        (value) => { this.mode = value; });
    }
    const keys = {paths: "paths", frames: "frames", ghosts: "ghosts", near: "nearest bodies", around: "obstacles and workpiece", floor: "floor"};
    const there = {near: this.motions.some((one) => one.near), around: this.motions.some((one) => one.around.length),
      floor: this.grid, ghosts: true, frames: this.motions.some((one) => one.data.tip), paths: this.motions.some((one) => one.data.tip)};
    for (const [name, text] of Object.entries(keys)) {
      if (!there[name]) continue;
      const label = document.createElement("label"), box = document.createElement("input");
      Object.assign(box, {type: "checkbox", checked: this.shown[name], id: `show-${name}`});
      box.addEventListener("change", () => { this.shown[name] = box.checked; this.schedule(); });
      label.append(box, ` ${text}`);
      options.append(label);
    }
  }

  chart() {
    const visible = this.visible, groups = new Map(), own = element("curves");
    const open = new Map([...own.querySelectorAll("details")].map((one) => [one.dataset.group, one.open]));
    for (const {motion, kind} of visible) for (const curve of motion.curves) {
      const charts = groups.get(curve.group) || groups.set(curve.group, new Map()).get(curve.group);
      charts.set(curve.name, [...(charts.get(curve.name) || []), {...curve, kind}]);
    }
    own.replaceChildren();
    this.charts = [];
    for (const [group, charts] of groups) {
      const details = document.createElement("details"), summary = document.createElement("summary");
      const box = document.createElement("div");
      details.dataset.group = group;
      details.open = open.has(group) ? open.get(group) : OPEN.includes(group);
      summary.textContent = group;
      box.className = "charts";
      const sizes = {};  // of each unit the largest value in the group
      for (const {unit, values} of [...charts.values()].flat()) for (const value of values)
        if (Number.isFinite(value)) sizes[unit] = Math.max(sizes[unit] || 0, Math.abs(value));
      for (const [name, curves] of charts) {
        const chart = new Chart(name, curves, LEAST * (sizes[curves[0].unit] || 0), this.horizon, (time) => { this.stop(); this.seek(time); });
        chart.hidden = () => !details.open;
        this.charts.push(chart);
        box.append(chart.figure);
      }
      const feet = visible.filter(({motion}) => motion.footing).map(({motion, kind}) => ({...motion.footing, kind}));
      if (group === "Standing" && feet.length) {
        const chart = new FootChart(feet);
        chart.hidden = () => !details.open;
        this.charts.push(chart);
        box.append(chart.figure);
      }
      details.addEventListener("toggle", () => this.set(this.time));
      details.append(summary, box);
      own.append(details);
    }
  }

  table() {
    const audit = element("audit"), {motion} = this.visible[0], {rows, verdict, passed} = motion.data;
    const sentence = element("verdict");
    sentence.textContent = [this.visible.length > 1 ? `${motion.name}: ` : "", verdict].join("");
    sentence.className = passed === true ? "good" : passed === false ? "bad" : "";
    audit.replaceChildren();
    const keys = document.createElement("p");
    const words = {plan: this.visible.length > 1 ? "the plan" : "the motion", other: "the compared motion"};
    const key = (kind, text, more = "") => `<span><i class="key ${more} ink-${kind}"></i>${text}</span>&emsp;`;
    keys.innerHTML = this.visible.map(({kind}) => key(kind, words[kind])).join("") +
      (motion.targets.length ? key("target", "the required path") : "") + key("limit", "limits, where near", "dashed");
    audit.append(keys);
    if (!rows.length) return;
    const head = document.createElement("h2"), table = document.createElement("table"), box = document.createElement("div");
    head.textContent = "The audit";
    box.className = "scroll";
    const number = (value, digits) => value === null ? "" : value && Math.abs(value) < 1e-4 ?
      value.toExponential(digits - 1) : String(+value.toPrecision(digits));
    const line = (cells, tag) => {
      const row = document.createElement("tr");
      cells.forEach((text, k) => {
        const cell = document.createElement(tag);
        cell.textContent = text;
        if ([1, 2, 4].includes(k)) cell.className = "n";
        if (text === "FAILED") cell.className = "bad";
        row.append(cell);
      });
      return row;
    };
    table.append(line(["quantity", "worst", "limit", "unit", "at, s", "", ""], "th"));
    for (const [name, value, limit, unit, time, word, note] of rows)
      table.append(line([name, number(value, 4), number(limit, 3), unit, number(time, 4), word, note], "td"));
    box.append(table);
    audit.append(head, box);
  }
}

(async () => {
  try {
    window.player = new Player(await unpacked());
    const missing = Object.keys(window.player.data.missing);
    element("foot").textContent = [missing.length ? `${missing.length} meshes are missing; the collision shapes of these links are shown: ` +
      missing.slice(0, 3).join(", ") + (missing.length > 3 ? ", …" : "") + ". " : "",
      "Drag to turn, shift and drag to shift, scroll to zoom, double click for the whole; space plays, arrows step. ",
      "SI units, radians. Written by selfmotion."].join("");
    document.documentElement.dataset.ready = "yes";
  } catch (error) {
    element("nearest").textContent = `${error.message || error}`;
    console.error(error);
  }
})();
