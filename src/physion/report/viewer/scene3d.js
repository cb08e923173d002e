// The scene in 3D: bodies and cloths at a frame, the ways of agent, patient and probe, and where
// they touch. Turned by mouse, touch or keys. WebGL 2, no library.

const SOLID = [`#version 300 es
  in vec3 point, normal;
  uniform mat4 view; uniform vec3 scale, shift; uniform vec4 turn;
  out vec3 side, place;
  vec3 turned(vec3 v) { return v + 2.0 * cross(turn.yzw, cross(turn.yzw, v) + turn.x * v); }
  void main() {
    place = turned(point * scale) + shift;
    side = turned(normal / scale);
    gl_Position = view * vec4(place, 1.0);
  }`, `#version 300 es
  precision highp float;
  in vec3 side, place; uniform vec3 color, eye; out vec4 shown;
  void main() {
    vec3 n = normalize(side), look = normalize(eye - place);
    if (dot(n, look) < 0.0) n = -n;
    float lamp = max(dot(n, normalize(vec3(0.35, -0.5, 0.8))), 0.0);
    float sky = 0.5 + 0.5 * n.z, rim = max(dot(n, look), 0.0);
    shown = vec4(color * (0.28 + 0.24 * sky + 0.4 * lamp + 0.16 * rim), 1.0);
  }`];

const PLAIN = [`#version 300 es
  in vec3 point; uniform mat4 view; uniform float size;
  void main() { gl_Position = view * vec4(point, 1.0); gl_PointSize = size; }`, `#version 300 es
  precision highp float;
  uniform vec4 color; out vec4 shown; void main() { shown = color; }`];

const WAY_COLORS = { agent: [0.9, 0.15, 0.15], patient: [0.85, 0.68, 0], probe: [0.5, 0.35, 0.9] };

function compile(gl, [vertex, fragment]) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "point");
  gl.bindAttribLocation(program, 1, "normal");
  gl.linkProgram(program);
  const at = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < count; i++) {
    const { name } = gl.getActiveUniform(program, i);
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

// Vertices on the graphics card; `faces` is null for points and lines.
class Buffers {
  constructor(gl, points, normals, faces, usage = gl.STATIC_DRAW) {
    this.gl = gl;
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    this.points = this.fill(0, points, gl.FLOAT, usage);
    if (normals) {
      const kind = normals instanceof Int8Array ? gl.BYTE : gl.FLOAT;
      this.normals = this.fill(1, normals, kind, usage);
    }
    if (faces) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    }
    this.count = faces ? faces.length : points.length / 3;
  }

  fill(place, values, kind, usage) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, usage);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, kind, kind === gl.BYTE, 0, 0);
    return buffer;
  }

  change(points, normals) {
    const { gl } = this;
    for (const [buffer, values] of [[this.points, points], [this.normals, normals]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, values);
    }
  }
}

// Where bodies and cloths are at a frame.
class Motion {
  constructor(data, shapes) {
    this.data = data;
    this.start = numbers(data.start.positions, Float32Array);
    this.startTurns = numbers(data.start.rotations, Int16Array);
    this.positions = numbers(data.positions, Float32Array);
    this.turns = numbers(data.rotations, Int16Array);
    this.place = new Map(data.moving.map((body, k) => [body, k]));
    this.cloths = data.cloths.map((cloth) => ({ ...cloth, points: gridPoints(cloth.points) }));
    this.middles = data.bodies.map((body) => {
      const { low, size } = shapes[body.shape].points;
      return low.map((v, i) => (v + size[i] / 2) * body.scale[i]);
    });
  }

  pose(body, frame) {
    const k = this.place.get(body);
    const moves = k !== undefined;
    const row = moves ? frame * this.data.moving.length + k : body;
    const [at, turns] = moves ? [this.positions, this.turns] : [this.start, this.startTurns];
    const turn = [...turns.subarray(4 * row, 4 * row + 4)];
    return { shift: [...at.subarray(3 * row, 3 * row + 3)], turn: unit(turn) };
  }

  middle(body, frame) {
    const { shift, turn } = this.pose(body, frame);
    return add(shift, turned(turn, this.middles[body]));
  }

  // The points of a cloth, on straight lines between the instants that were kept.
  sheet(cloth, frame) {
    const { instants, points, side } = cloth;
    let k = 0;
    while (k < instants.length - 2 && instants[k + 1] <= frame) k++;
    const next = Math.min(k + 1, instants.length - 1);
    const span = instants[next] - instants[k];
    const share = span > 0 ? clamp((frame - instants[k]) / span, 0, 1) : 0;
    const size = 3 * side * side;
    const out = new Float32Array(size);
    for (let i = 0; i < size; i++) {
      out[i] = (1 - share) * points[k * size + i] + share * points[next * size + i];
    }
    return out;
  }

  // The way of a thing with a role: one point a frame.
  way(role) {
    const out = new Float32Array(3 * this.data.frames);
    const body = this.data.bodies.findIndex((b) => b.role === role);
    const cloth = this.cloths.find((c) => c.role === role);
    if (!this.place.has(body) && !cloth) return null;
    for (let frame = 0; frame < this.data.frames; frame++) {
      out.set(cloth ? this.mean(this.sheet(cloth, frame)) : this.middle(body, frame), 3 * frame);
    }
    return out;
  }

  mean(points) {
    const sum = [0, 0, 0];
    for (let i = 0; i < points.length; i++) sum[i % 3] += points[i];
    return times(sum, 3 / points.length);
  }
}

function sheetFaces(side) {
  const faces = [];
  for (let i = 0; i < side - 1; i++) {
    for (let j = 0; j < side - 1; j++) {
      const a = i * side + j;
      faces.push(a, a + side, a + side + 1, a, a + side + 1, a + 1);
    }
  }
  return new Uint16Array(faces);
}

function sheetNormals(points, faces) {
  const out = new Float32Array(points.length);
  const at = (i) => [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
  for (let t = 0; t < faces.length; t += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => at(faces[t + k]));
    const normal = cross(subtract(b, a), subtract(c, a));
    for (let k = 0; k < 3; k++) for (let i = 0; i < 3; i++) out[3 * faces[t + k] + i] += normal[i];
  }
  return out;
}

class Scene3D {
  constructor(canvas, data, shapes) {
    this.canvas = canvas;
    this.motion = new Motion(data, shapes);
    this.data = data;
    this.frame = 0;
    this.limit = data.frames;
    this.scenery = true;
    this.ways = true;
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    this.reset();
    if (!this.gl) return;
    this.build(shapes);
    this.listen();
    this.watcher = new ResizeObserver(() => this.draw());
    this.watcher.observe(canvas);
  }

  close() {
    if (!this.gl) return;
    this.watcher.disconnect();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
    this.gl = null;
  }

  reset() {
    const { position, target, fov } = this.data.camera;
    const away = subtract(position, target);
    this.target = [...target];
    this.distance = norm(away) || 1;
    this.azimuth = Math.atan2(away[1], away[0]);
    this.elevation = Math.asin(clamp(away[2] / this.distance, -1, 1));
    this.fov = fov;
    this.draw();
  }

  build(shapes) {
    const { gl } = this;
    this.solid = compile(gl, SOLID);
    this.plain = compile(gl, PLAIN);
    this.meshes = {};
    for (const { shape } of this.data.bodies) {
      const { points, normals, faces } = shapes[shape];
      this.meshes[shape] ??= new Buffers(
        gl, gridPoints(points), numbers(normals, Int8Array), numbers(faces, Uint16Array),
      );
    }
    this.sheets = this.motion.cloths.map((cloth) => {
      const faces = sheetFaces(cloth.side);
      const points = this.motion.sheet(cloth, 0);
      const usage = gl.DYNAMIC_DRAW;
      return { cloth, faces, buffers: new Buffers(gl, points, new Float32Array(points.length), faces, usage) };
    });
    this.floor = new Buffers(gl, floorLines(this.data.floor), null, null);
    this.lines = Object.keys(WAY_COLORS).flatMap((role) => {
      const points = this.motion.way(role);
      return points ? [{ color: WAY_COLORS[role], buffers: new Buffers(gl, points, null, null) }] : [];
    });
    this.touchFrames = this.data.touches.map((touch) => touch[0]);
    this.touches = new Buffers(
      gl, new Float32Array(this.data.touches.flatMap((touch) => touch.slice(1))), null, null,
    );
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  eye() {
    const flat = Math.cos(this.elevation);
    const away = [
      flat * Math.cos(this.azimuth), flat * Math.sin(this.azimuth), Math.sin(this.elevation),
    ];
    return add(this.target, times(away, this.distance));
  }

  show(frame) {
    this.frame = frame;
    this.draw();
  }

  draw() {
    const { gl, canvas } = this;
    if (!gl || !this.solid || this.waiting) return;
    // Many changes between two pictures of the screen are drawn once.
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      if (this.gl) this.paint(gl, canvas);
    });
  }

  paint(gl, canvas) {
    const sharp = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * sharp)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    gl.clearColor(...(dark ? [0.12, 0.135, 0.16] : [0.93, 0.945, 0.96]), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const eye = this.eye();
    const far = this.distance + 60;
    const lens = perspective(this.fov, width / height, Math.max(0.02, far / 5000), far);
    const view = multiply(lens, lookAt(eye, this.target));
    this.paintSolids(gl, view, eye);
    this.paintLines(gl, view, dark, sharp);
  }

  paintSolids(gl, view, eye) {
    const { at, program } = this.solid;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.view, false, view);
    gl.uniform3fv(at.eye, eye);
    this.data.bodies.forEach((body, i) => {
      if (body.scenery && !this.scenery) return;
      const { shift, turn } = this.motion.pose(i, this.frame);
      this.paintMesh(gl, this.meshes[body.shape], body.color, body.scale, shift, turn);
    });
    for (const { cloth, faces, buffers } of this.sheets) {
      const points = this.motion.sheet(cloth, this.frame);
      buffers.change(points, sheetNormals(points, faces));
      this.paintMesh(gl, buffers, cloth.color, [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]);
    }
  }

  paintMesh(gl, buffers, color, scale, shift, turn) {
    const { at } = this.solid;
    gl.uniform3fv(at.color, color);
    gl.uniform3fv(at.scale, scale);
    gl.uniform3fv(at.shift, shift);
    gl.uniform4fv(at.turn, turn);
    gl.bindVertexArray(buffers.array);
    gl.drawElements(gl.TRIANGLES, buffers.count, gl.UNSIGNED_SHORT, 0);
  }

  paintLines(gl, view, dark, sharp) {
    const { at, program } = this.plain;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.view, false, view);
    const paint = (buffers, mode, color, size, first, count) => {
      if (count < 1) return;
      gl.uniform4fv(at.color, color);
      gl.uniform1f(at.size, size * sharp);
      gl.bindVertexArray(buffers.array);
      gl.drawArrays(mode, first, count);
    };
    paint(this.floor, gl.LINES, dark ? [1, 1, 1, 0.14] : [0, 0, 0, 0.14], 1, 0, this.floor.count);
    if (!this.ways) return;
    for (const { color, buffers } of this.lines) {
      const done = this.frame + 1;
      paint(buffers, gl.LINE_STRIP, [...color, 1], 1, 0, done);
      paint(buffers, gl.POINTS, [...color, 1], 4, 0, done);
      paint(buffers, gl.POINTS, [...color, 0.35], 2.5, done, this.limit - done);
    }
    // What has touched by now lies before everything, since touches hide between the bodies.
    const touched = this.touchFrames.filter((frame) => frame <= this.frame).length;
    gl.disable(gl.DEPTH_TEST);
    paint(this.touches, gl.POINTS, dark ? [1, 1, 1, 1] : [0, 0, 0, 1], 5, 0, touched);
    gl.enable(gl.DEPTH_TEST);
  }

  orbit(right, up) {
    this.azimuth -= right;
    this.elevation = clamp(this.elevation + up, -0.3, 1.55);
    this.draw();
  }

  zoom(factor) {
    this.distance = clamp(this.distance * factor, 0.2, 60);
    this.draw();
  }

  pan(right, up) {
    const back = unit(subtract(this.eye(), this.target));
    const side = unit(cross([0, 0, 1], back));
    const move = add(times(side, -right), times(cross(back, side), -up));
    this.target = add(this.target, times(move, this.distance));
    this.draw();
  }

  listen() {
    const { canvas } = this;
    const held = new Map();
    const spread = () => {
      const [a, b] = [...held.values()];
      return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
    };
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, event);
      canvas.focus({ preventScroll: true });
    };
    canvas.onpointerup = canvas.onpointercancel = (event) => held.delete(event.pointerId);
    canvas.onpointermove = (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
      const apart = held.size === 2 ? spread() : 0;
      held.set(event.pointerId, event);
      const size = canvas.clientHeight;
      if (apart > 0) this.zoom(apart / Math.max(spread(), 1));
      else if (event.shiftKey || event.buttons === 2) this.pan(dx / size, -dy / size);
      else this.orbit((3 * dx) / size, (3 * dy) / size);
    };
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(clamp(event.deltaY, -100, 100) / 500));
    }, { passive: false });
    canvas.onkeydown = (event) => this.key(event);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const arrow = arrows[event.key];
    if (arrow && event.shiftKey) this.pan(arrow[0] / 20, arrow[1] / 20);
    else if (arrow) this.orbit(arrow[0] / 10, arrow[1] / 10);
    else if (event.key === "+" || event.key === "=") this.zoom(1 / 1.1);
    else if (event.key === "-") this.zoom(1.1);
    else if (event.key === "0") this.reset();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}

// A grid of metres, in pieces of one: software drivers drop long lines that pass the camera.
function floorLines(height) {
  const points = [];
  for (let i = -6; i <= 6; i++) {
    for (let j = -6; j < 6; j++) points.push(i, j, height, i, j + 1, height, j, i, height, j + 1, i, height);
  }
  return new Float32Array(points);
}
