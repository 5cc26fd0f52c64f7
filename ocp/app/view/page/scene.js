// The scene: surfaces, lines and a camera, by WebGL 2 alone. Frames are z up; matrices are columns of sixteen numbers.

const SURFACE_VERTEX = `#version 300 es
uniform mat4 view; uniform mat4 model; uniform vec3 low; uniform vec3 grain;
layout(location = 0) in vec3 corner; layout(location = 1) in vec3 normal;
out vec3 turned; out vec3 place;
void main() {
  vec4 world = model * vec4(low + grain * corner, 1.0);
  turned = mat3(model) * normal; place = world.xyz; gl_Position = view * world;
}`;
const SURFACE_FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 color; uniform vec3 eye;
in vec3 turned; in vec3 place; out vec4 shown;
void main() {
  vec3 n = normalize(turned), to = normalize(eye - place);
  if (dot(n, to) < 0.0) n = -n;
  float sky = 0.5 + 0.5 * n.z, key = max(dot(n, normalize(vec3(0.35, -0.5, 0.8))), 0.0);
  float lamp = max(dot(n, to), 0.0), gloss = pow(max(dot(reflect(-to, n), normalize(vec3(0.35, -0.5, 0.8))), 0.0), 24.0);
  vec3 lit = color.rgb * (0.34 + 0.22 * sky + 0.42 * key + 0.14 * lamp) + 0.12 * gloss;
  shown = vec4(lit * color.a, color.a);
}`;
const LINE_VERTEX = `#version 300 es
uniform mat4 view; uniform mat4 model; uniform vec2 size; uniform float width;
layout(location = 0) in vec2 side; layout(location = 1) in vec3 start; layout(location = 2) in vec3 end;
void main() {
  vec4 a = view * model * vec4(start, 1.0), b = view * model * vec4(end, 1.0);
  float near = 1e-4;
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * size;
  along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  vec4 at = mix(a, b, side.x);
  vec2 shift = (vec2(-along.y, along.x) * side.y + along * (2.0 * side.x - 1.0) * 0.5) * width / size;
  gl_Position = at + vec4(shift * at.w, -1e-4 * at.w, 0.0);
}`;
const LINE_FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 color; out vec4 shown;
void main() { shown = vec4(color.rgb * color.a, color.a); }`;

const IDENTITY = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);

function matrixOf(pose, at) {  // position and quaternion [w, x, y, z]
  const [x0, y0, z0, w, x, y, z] = pose.subarray(at, at + 7);
  const s = 2 / (w * w + x * x + y * y + z * z);
  return new Float32Array([
    1 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y), 0,
    s * (x * y - w * z), 1 - s * (x * x + z * z), s * (y * z + w * x), 0,
    s * (x * z + w * y), s * (y * z - w * x), 1 - s * (x * x + y * y), 0, x0, y0, z0, 1]);
}

function product(a, b) {
  const c = new Float32Array(16);
  for (let i = 0; i < 4; i++) for (let j = 0; j < 4; j++) {
    let sum = 0;
    for (let k = 0; k < 4; k++) sum += a[4 * k + i] * b[4 * j + k];
    c[4 * j + i] = sum;
  }
  return c;
}

class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = this.gl = canvas.getContext("webgl2", {antialias: true, alpha: true, premultipliedAlpha: true,
      preserveDrawingBuffer: true});
    if (!gl) throw new Error("this browser has no WebGL 2, which the picture needs");
    this.surfaces = this.program(SURFACE_VERTEX, SURFACE_FRAGMENT, ["view", "model", "low", "grain", "color", "eye"]);
    this.strokes = this.program(LINE_VERTEX, LINE_FRAGMENT, ["view", "model", "size", "width", "color"]);
    this.corners = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]), gl.STATIC_DRAW);
    this.home = {at: [0, 0, 0.5], far: 3, turn: -0.95, rise: 0.42};
    this.camera = {...this.home, at: [...this.home.at]};
    this.changed = () => {};
    this.listen();
  }

  program(vertex, fragment, names) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return {program, at: Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]))};
  }

  surface(data, arrays) {  // store the vertices, normals and faces of a surface in the graphics card
    const gl = this.gl, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const put = (data, kind) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(kind, buffer);
      gl.bufferData(kind, data, gl.STATIC_DRAW);
    };
    put(arrays(data.vertices), gl.ARRAY_BUFFER);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, false, 8, 0);
    put(arrays(data.normals), gl.ARRAY_BUFFER);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 3, gl.BYTE, true, 4, 0);
    const faces = arrays(data.faces);
    put(faces, gl.ELEMENT_ARRAY_BUFFER);
    gl.bindVertexArray(null);
    const kind = faces instanceof Uint16Array ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT;
    return {array, count: faces.length, kind, low: data.low, grain: data.step};
  }

  line(segments, dynamic) {  // store line segments: pairs of points, six numbers each
    const gl = this.gl, array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, segments, dynamic ? gl.DYNAMIC_DRAW : gl.STATIC_DRAW);
    for (const [place, from] of [[1, 0], [2, 12]]) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 24, from);
      gl.vertexAttribDivisor(place, 1);
    }
    gl.bindVertexArray(null);
    return {array, buffer, count: segments.length / 6};
  }

  refill(line, segments) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, line.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, segments, gl.DYNAMIC_DRAW);
    line.count = segments.length / 6;
  }

  look(low, high) {  // aim the camera at a box
    const size = Math.hypot(...high.map((value, k) => value - low[k]));
    this.home = {...this.home, at: high.map((value, k) => (value + low[k]) / 2), far: 1.25 * Math.max(size, 0.1)};
    this.reset();
  }

  reset() { this.camera = {...this.home, at: [...this.home.at]}; this.changed(); }

  begin() {
    const gl = this.gl, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, {width, height});
    this.ratio = ratio;
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  part(number, count) {  // draw into one of `count` parts of the canvas, numbered from the left
    const gl = this.gl, width = this.canvas.width / count, height = this.canvas.height;
    gl.viewport(Math.round(number * width), 0, Math.round(width), height);
    this.size = [width / 2, height / 2];
    const {at, far, turn, rise} = this.camera;
    const back = [Math.cos(rise) * Math.cos(turn), Math.cos(rise) * Math.sin(turn), Math.sin(rise)];
    this.eye = at.map((value, k) => value + far * back[k]);
    const right = [-Math.sin(turn), Math.cos(turn), 0];
    const up = [-Math.sin(rise) * Math.cos(turn), -Math.sin(rise) * Math.sin(turn), Math.cos(rise)];
    this.axes = {right, up};
    const dot = (a) => -(a[0] * this.eye[0] + a[1] * this.eye[1] + a[2] * this.eye[2]);
    const look = new Float32Array([right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2],
      0, dot(right), dot(up), dot(back), 1]);
    const near = 0.02 * far, last = 60 * far, lens = 1 / Math.tan(0.32), aspect = width / height;
    const wide = aspect < 1 ? lens * aspect : lens;
    const project = new Float32Array([wide / aspect, 0, 0, 0, 0, wide, 0, 0, 0, 0, (last + near) / (near - last), -1, 0,
      0, 2 * last * near / (near - last), 0]);
    this.view = product(project, look);
  }

  drawSurface(surface, model, color) {
    const gl = this.gl, {program, at} = this.surfaces;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.view, false, this.view);
    gl.uniformMatrix4fv(at.model, false, model);
    gl.uniform3fv(at.low, surface.low);
    gl.uniform3f(at.grain, ...surface.grain);
    gl.uniform4fv(at.color, color);
    gl.uniform3fv(at.eye, this.eye);
    gl.bindVertexArray(surface.array);
    gl.drawElements(gl.TRIANGLES, surface.count, surface.kind, 0);
  }

  drawFaint(draw) {  // draw transparently: only the nearest surface, behind solid ones at the same place
    const gl = this.gl;
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(2, 8);
    gl.colorMask(false, false, false, false);
    draw();
    gl.colorMask(true, true, true, true);
    draw();
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  drawLine(line, color, width, model = IDENTITY, count = line.count) {
    if (!count) return;
    const gl = this.gl, {program, at} = this.strokes;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.view, false, this.view);
    gl.uniformMatrix4fv(at.model, false, model);
    gl.uniform2fv(at.size, this.size);
    gl.uniform1f(at.width, 0.5 * width * this.ratio);
    gl.uniform4fv(at.color, color);
    gl.bindVertexArray(line.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }

  listen() {  // dragging turns; with shift or another button it shifts; two fingers do both; the wheel zooms
    const canvas = this.canvas, fingers = new Map();
    const shift = (dx, dy) => {
      const scale = this.camera.far / canvas.clientHeight * 0.66;
      const {right, up} = this.axes;
      this.camera.at = this.camera.at.map((value, k) => value - scale * (dx * right[k] - dy * up[k]));
    };
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", () => this.reset());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.camera.far *= Math.exp(0.0012 * event.deltaY);
      this.changed();
    }, {passive: false});
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const dx = event.clientX - before[0], dy = event.clientY - before[1];
      if (fingers.size === 2) {
        const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
        const apart = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
        this.camera.far *= apart(before) / apart([event.clientX, event.clientY]);
        shift(dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons & 6) shift(dx, dy);
      else {
        this.camera.turn -= 0.008 * dx;
        this.camera.rise = Math.max(-1.5, Math.min(1.5, this.camera.rise + 0.008 * dy));
      }
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      this.changed();
    });
  }
}
