// 3D view of the scene: bodies and cloths at a frame, the paths of agent, patient and probe, and
// their contact points. Controlled by mouse, touch or keys. WebGL 2, no library.

const PATH_COLORS = { agent: [0.9, 0.15, 0.15], patient: [0.85, 0.68, 0], probe: [0.5, 0.35, 0.9] };

class Scene3D {
  constructor(canvas, data, shapes, imagined = []) {
    this.canvas = canvas;
    this.motion = new Motion(data, shapes);
    this.data = data;
    this.frame = 0;
    this.limit = data.frames;
    this.scenery = true;
    this.paths = true;
    /** Index of the model whose particles are shown, -1 for none. */
    this.imaginedBy = -1;
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    this.reset();
    if (!this.gl) return;
    this.build(shapes);
    this.imagined = imagined.map(({ particles }) => particles && new ImaginedParticles(this.gl, particles));
    this.addListeners();
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(canvas);
  }

  close() {
    if (!this.gl) return;
    this.observer.disconnect();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
    this.gl = null;
  }

  reset() {
    const { position, target, fov } = this.data.camera;
    const offset = subtract(position, target);
    this.target = [...target];
    this.distance = norm(offset) || 1;
    this.azimuth = Math.atan2(offset[1], offset[0]);
    this.elevation = Math.asin(clamp(offset[2] / this.distance, -1, 1));
    this.fov = fov;
    this.draw();
  }

  build(shapes) {
    const { gl } = this;
    this.meshProgram = compile(gl, MESH_SHADERS);
    this.lineProgram = compile(gl, LINE_SHADERS);
    this.meshes = {};
    for (const { shape } of this.data.bodies) {
      const { points, normals, faces } = shapes[shape];
      this.meshes[shape] ??= new Buffers(
        gl, decodePoints(points), decodeArray(normals, Int8Array), decodeArray(faces, Uint16Array),
      );
    }
    this.clothMeshes = this.motion.cloths.map((cloth) => {
      const faces = clothFaces(cloth.side);
      const points = this.motion.clothVertices(cloth, 0);
      const usage = gl.DYNAMIC_DRAW;
      return { cloth, faces, buffers: new Buffers(gl, points, new Float32Array(points.length), faces, usage) };
    });
    this.floor = new Buffers(gl, floorLines(this.data.floor), null, null);
    this.pathLines = Object.keys(PATH_COLORS).flatMap((role) => {
      const points = this.motion.path(role);
      return points ? [{ color: PATH_COLORS[role], buffers: new Buffers(gl, points, null, null) }] : [];
    });
    this.contactFrames = this.data.contactPoints.map(([frame]) => frame);
    this.contactPoints = new Buffers(
      gl, new Float32Array(this.data.contactPoints.flatMap(([, ...point]) => point)), null, null,
    );
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  eye() {
    const horizontal = Math.cos(this.elevation);
    const offset = [
      horizontal * Math.cos(this.azimuth), horizontal * Math.sin(this.azimuth), Math.sin(this.elevation),
    ];
    return add(this.target, times(offset, this.distance));
  }

  show(frame) {
    this.frame = frame;
    this.draw();
  }

  draw() {
    const { gl, canvas } = this;
    if (!gl || !this.meshProgram || this.request) return;
    // Draw several changes within one animation frame only once.
    this.request = requestAnimationFrame(() => {
      this.request = 0;
      if (this.gl) this.paint(gl, canvas);
    });
  }

  paint(gl, canvas) {
    const pixelRatio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * pixelRatio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const background = dark ? [0.12, 0.135, 0.16] : [0.93, 0.945, 0.96];
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const eye = this.eye();
    const far = this.distance + 60;
    const projection = perspective(this.fov, width / height, Math.max(0.02, far / 5000), far);
    const view = multiply(projection, lookAt(eye, this.target));
    this.paintBodies(gl, view, eye, background);
    this.paintLines(gl, view, dark, pixelRatio);
  }

  // Return the particles to be shown at this frame, if there are any.
  shownParticles() {
    const particles = this.imagined[this.imaginedBy];
    return particles && this.frame >= particles.from ? particles : null;
  }

  paintBodies(gl, view, eye, background) {
    const { uniforms, program } = this.meshProgram;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.view, false, view);
    gl.uniform3fv(uniforms.eye, eye);
    // What is true is paler while imagined particles are shown, which have the same colours.
    const faded = this.shownParticles() !== null;
    const shade = (color) => (faded ? add(times(color, 0.35), times(background, 0.65)) : color);
    this.data.bodies.forEach((body, i) => {
      if (body.scenery && !this.scenery) return;
      const { position, rotation } = this.motion.pose(i, this.frame);
      this.paintMesh(gl, this.meshes[body.shape], shade(body.color), body.scale, position, rotation);
    });
    for (const { cloth, faces, buffers } of this.clothMeshes) {
      const points = this.motion.clothVertices(cloth, this.frame);
      buffers.update(points, clothNormals(points, faces));
      this.paintMesh(gl, buffers, shade(cloth.color), [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]);
    }
  }

  paintMesh(gl, buffers, color, scale, position, rotation) {
    const { uniforms } = this.meshProgram;
    gl.uniform3fv(uniforms.color, color);
    gl.uniform3fv(uniforms.scale, scale);
    gl.uniform3fv(uniforms.translation, position);
    gl.uniform4fv(uniforms.rotation, rotation);
    gl.bindVertexArray(buffers.vertexArray);
    gl.drawElements(gl.TRIANGLES, buffers.count, gl.UNSIGNED_SHORT, 0);
  }

  paintLines(gl, view, dark, pixelRatio) {
    const { uniforms, program } = this.lineProgram;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.view, false, view);
    const paint = (buffers, mode, color, size, first, count) => {
      if (count < 1) return;
      gl.uniform4fv(uniforms.color, color);
      gl.uniform1f(uniforms.size, size * pixelRatio);
      gl.bindVertexArray(buffers.vertexArray);
      gl.drawArrays(mode, first, count);
    };
    paint(this.floor, gl.LINES, dark ? [1, 1, 1, 0.14] : [0, 0, 0, 0.14], 1, 0, this.floor.count);
    const particles = this.shownParticles();
    if (this.paths) this.paintPaths(gl, paint, dark, particles === null);
    if (!particles) return;
    // In front of all that is true, so that nothing of it hides them.
    gl.clear(gl.DEPTH_BUFFER_BIT);
    particles.paint(this.frame, dark, (buffers, color, first, count) => {
      paint(buffers, gl.POINTS, [...color, 1], 3.5, first, count);
    });
  }

  paintPaths(gl, paint, dark, dots) {
    for (const { color, buffers } of this.pathLines) {
      const reached = this.frame + 1;
      paint(buffers, gl.LINE_STRIP, [...color, 1], 1, 0, reached);
      if (!dots) continue;
      paint(buffers, gl.POINTS, [...color, 1], 4, 0, reached);
      paint(buffers, gl.POINTS, [...color, 0.35], 2.5, reached, this.limit - reached);
    }
    // Contact points so far are drawn in front, since they are hidden between the bodies.
    const contacts = this.contactFrames.filter((frame) => frame <= this.frame).length;
    gl.disable(gl.DEPTH_TEST);
    paint(this.contactPoints, gl.POINTS, dark ? [1, 1, 1, 1] : [0, 0, 0, 1], 5, 0, contacts);
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

  addListeners() {
    const { canvas } = this;
    const pointers = new Map();
    const pointerDistance = () => {
      const [a, b] = [...pointers.values()];
      return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
    };
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
      canvas.focus({ preventScroll: true });
    };
    canvas.onpointerup = canvas.onpointercancel = (event) => pointers.delete(event.pointerId);
    canvas.onpointermove = (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
      const distanceBefore = pointers.size === 2 ? pointerDistance() : 0;
      pointers.set(event.pointerId, event);
      const size = canvas.clientHeight;
      if (distanceBefore > 0) this.zoom(distanceBefore / Math.max(pointerDistance(), 1));
      else if (event.shiftKey || event.buttons === 2) this.pan(dx / size, -dy / size);
      else this.orbit((3 * dx) / size, (3 * dy) / size);
    };
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(clamp(event.deltaY, -100, 100) / 500));
    }, { passive: false });
    canvas.onkeydown = (event) => this.onKey(event);
  }

  onKey(event) {
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
