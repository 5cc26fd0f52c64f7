// Curves over time with limits and a cursor, and the path of the zero moment point in its footprint, as inline SVG.

const SPACE = "http://www.w3.org/2000/svg";
const WIDE = 240, TALL = 96, LEFT = 42, RIGHT = 6, TOP = 6, BOTTOM = 14;
const LEAST = 0.2;  // least range of a diagram relative to the largest value of its unit in the group: what hardly
// changes looks constant, and what is zero beside the other curves looks like zero
const OPEN = ["Cost", "The motion", "Standing", "Momentum", "Joints"];

function shape(kind, attributes, parent) {
  const node = document.createElementNS(SPACE, kind);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (parent) parent.append(node);
  return node;
}

function formatted(value) {
  if (!Number.isFinite(value)) return "";
  const size = Math.abs(value);
  if (size < 1e-9) return "0";
  if ((size < 1e-3 || size >= 1e5)) return value.toExponential(1).replace("e+", "e");
  return String(+value.toPrecision(3));
}

function valueAt(times, values, time) {
  if (time <= times[0]) return values[0];
  const last = times.length - 1;
  if (time >= times[last]) return values[last];
  let low = 0, high = last;
  while (high - low > 1) { const middle = (low + high) >> 1; if (times[middle] <= time) low = middle; else high = middle; }
  const share = (time - times[low]) / (times[high] - times[low] || 1);
  return values[low] + share * (values[high] - values[low]);
}

class Chart {
  constructor(name, curves, least, horizon, seek) {  // curves: {motion, unit, lower, upper, times, values, kind}
    this.curves = curves;
    this.least = least;
    this.horizon = horizon;
    this.figure = document.createElement("figure");
    this.figure.className = "chart";
    const caption = document.createElement("figcaption"), title = document.createElement("b");
    title.textContent = name;
    title.title = name;
    this.readout = document.createElement("span");
    caption.append(title, this.readout);
    this.svg = shape("svg", {viewBox: `0 0 ${WIDE} ${TALL}`, role: "img", "aria-label": `${name} over time`});
    this.figure.append(caption, this.svg);
    this.draw();
    const move = (event) => {
      if (event.type === "pointermove" && !event.buttons) return;
      const box = this.svg.getBoundingClientRect();
      const share = ((event.clientX - box.left) / box.width * WIDE - LEFT) / (WIDE - LEFT - RIGHT);
      seek(this.horizon * Math.max(0, Math.min(1, share)));
    };
    this.svg.addEventListener("pointerdown", move);
    this.svg.addEventListener("pointermove", move);
  }

  draw() {
    let low = Infinity, high = -Infinity;
    for (const {values} of this.curves) for (const value of values)
      if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
    if (!(low <= high)) { low = 0; high = 1; }
    const limits = new Set(this.curves.flatMap(({lower, upper}) => [lower, upper]).filter((one) => one !== null));
    const reach = Math.max(high - low, this.least, 2e-5);  // 2e-5: zero alone has no size
    for (const limit of [...limits])  // limits far away would flatten the curve
      if (limit < low - 3 * reach || limit > high + 3 * reach) limits.delete(limit);
    for (const limit of limits) { low = Math.min(low, limit); high = Math.max(high, limit); }
    const more = (reach - (high - low)) / 2;
    if (more > 0) { low -= more; high += more; }
    const room = 0.05 * (high - low);
    low -= room;
    high += room;
    this.x = (time) => LEFT + (WIDE - LEFT - RIGHT) * time / this.horizon;
    const y = (value) => TOP + (TALL - TOP - BOTTOM) * (high - value) / (high - low);
    shape("path", {class: "axis", d: `M${LEFT} ${TOP}V${TALL - BOTTOM}H${WIDE - RIGHT}`}, this.svg);
    for (const value of [low + room, high - room]) {
      const label = shape("text", {x: LEFT - 3, y: y(value) + 3, "text-anchor": "end"}, this.svg);
      label.textContent = formatted(value);
    }
    for (const [time, anchor] of [[0, "start"], [this.horizon, "end"]]) {
      const label = shape("text", {x: this.x(time), y: TALL - 3, "text-anchor": anchor}, this.svg);
      label.textContent = time ? `${formatted(time)} s` : "0";
    }
    for (const limit of limits)
      shape("line", {class: "limit", x1: LEFT, x2: WIDE - RIGHT, y1: y(limit), y2: y(limit)}, this.svg);
    for (const curve of [...this.curves].reverse()) {
      let path = "", pen = "M";
      const step = Math.max(1, Math.floor(curve.values.length / 300));
      for (let k = 0; k < curve.values.length; k += step) {
        const value = curve.values[k];
        if (!Number.isFinite(value)) { pen = "M"; continue; }
        path += `${pen}${this.x(curve.times[k]).toFixed(1)} ${y(value).toFixed(1)}`;
        pen = "L";
      }
      const last = curve.values.length - 1;
      if (pen === "L") path += `L${this.x(curve.times[last]).toFixed(1)} ${y(curve.values[last]).toFixed(1)}`;
      shape("path", {class: `curve ${curve.kind}`, d: path}, this.svg);
    }
    this.cursor = shape("line", {class: "cursor", x1: 0, x2: 0, y1: TOP, y2: TALL - BOTTOM}, this.svg);
    this.show(0);
  }

  show(time) {
    this.cursor.setAttribute("transform", `translate(${this.x(Math.min(time, this.horizon)).toFixed(2)} 0)`);
    this.readout.replaceChildren(...this.curves.map((curve, k) => {
      const value = document.createElement("span");
      value.className = `ink-${curve.kind}`;
      value.textContent = `${k ? " | " : ""}${formatted(valueAt(curve.times, curve.values, time))}`;
      return value;
    }), ` ${this.curves[0].unit}`);
  }
}

class FootChart {
  constructor(feet) {  // feet: {corners, times, points, kind}
    this.feet = feet;
    this.figure = document.createElement("figure");
    this.figure.className = "chart";
    const caption = document.createElement("figcaption"), title = document.createElement("b");
    const lacking = feet.length > 1 && feet[0].forces !== feet[1].forces ? `, ${feet[0].forces ? "the compared motion" :
      "the plan"} without external forces` : feet[0].forces ? "" : ", without external forces";
    title.textContent = `zero moment point in the footprint, seen from above${lacking}`;
    caption.append(title);
    const all = feet.flatMap(({corners, points}) => [...corners.map(([x, y]) => [x, y]),
      ...Array.from({length: points.length / 2}, (_, k) => [points[2 * k], points[2 * k + 1]])]).filter(
      (one) => one.every(Number.isFinite));
    const [xs, ys] = [all.map(([x]) => x), all.map(([, y]) => y)];
    const low = [Math.min(...xs), Math.min(...ys)], high = [Math.max(...xs), Math.max(...ys)];
    const scale = Math.min((WIDE - 20) / (high[0] - low[0] || 1), (150 - 20) / (high[1] - low[1] || 1));
    this.x = (x) => WIDE / 2 + scale * (x - (low[0] + high[0]) / 2);
    this.y = (y) => 75 - scale * (y - (low[1] + high[1]) / 2);
    const svg = shape("svg", {viewBox: `0 0 ${WIDE} 150`, role: "img", "aria-label": title.textContent});
    shape("polygon", {class: "axis", points: feet[0].corners.map(([x, y]) => `${this.x(x)},${this.y(y)}`).join(" ")}, svg);
    this.dots = [...feet].reverse().map((foot) => {
      let path = "";
      for (let k = 0; k < foot.points.length / 2; k++)
        path += `${k ? "L" : "M"}${this.x(foot.points[2 * k]).toFixed(1)} ${this.y(foot.points[2 * k + 1]).toFixed(1)}`;
      shape("path", {class: `curve ${foot.kind}`, d: path}, svg);
      return [foot, shape("circle", {class: `dot ${foot.kind}`, r: 4}, svg)];
    });
    this.figure.append(caption, svg);
    this.show(0);
  }

  show(time) {
    for (const [foot, dot] of this.dots) {
      const [x, y] = [0, 1].map((k) => valueAt(foot.times, foot.points.filter((_, i) => i % 2 === k), time));
      dot.setAttribute("transform", `translate(${this.x(x)} ${this.y(y)})`);
    }
  }
}
