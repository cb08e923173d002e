// The 3D view of a trial: its glTF file, shown by three.js, with paths, contacts and what a model
// imagined on top. Everything hangs below the node `world` of the file, where z points upwards.

const PARTICLE_COLORS = { agent: [0.88, 0.08, 0.08], patient: [0.93, 0.72, 0] };
const PATH_COLORS = { agent: "--agent", patient: "--patient", probe: "--probe" };
/** Opacity of what is true, while imagined particles are shown. */
const PALE = 0.3;

class Scene3D {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {any} detail Data of the trial: `gltf`, `paths`, `touches`, `imagined`.
   */
  constructor(canvas, detail) {
    this.canvas = canvas;
    this.detail = detail;
    this.frame = 0;
    this.limit = Infinity;
    this.paths = true;
    this.scenery = true;
    this.imaginedBy = -1;
    this.renderer = new Three.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.scene = new Three.Scene();
    this.camera = new Three.PerspectiveCamera();
    this.controls = new Three.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.draw());
    canvas.onkeydown = (event) => this.onKey(event);
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(canvas);
    new Three.GLTFLoader().parse(decodeBytes(detail.gltf).buffer, "", (gltf) => this.fill(gltf), (error) => {
      console.error(error);
    });
  }

  close() {
    this.closed = true;
    this.observer.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  fill(gltf) {
    if (this.closed) return;
    const { detail } = this;
    this.world = gltf.scene.getObjectByName("world");
    this.extras = gltf.scene.userData;
    const day = new Three.HemisphereLight(0xffffff, 0x8a8f99, 1.8);
    const sun = new Three.DirectionalLight(0xffffff, 1.3);
    sun.position.set(0.35, 0.8, 0.5);
    this.scene.add(gltf.scene, day, sun);
    this.materials = [];
    gltf.scene.traverse((node) => node.material && this.materials.push(node.material));
    for (const material of this.materials) material.transparent = true;
    this.grid = this.floor(this.extras.floor);
    if (gltf.animations.length) {
      this.mixer = new Three.AnimationMixer(gltf.scene);
      this.action = this.mixer.clipAction(gltf.animations[0]).play();
      // The time line of the page decides the time.
      this.action.paused = true;
    }
    this.lines = Object.entries(detail.paths).map(([role, path]) => this.line(role, decodeArray(path, Float32Array)));
    this.touches = this.points(new Float32Array(detail.touches.flatMap(([, ...point]) => point)), 7);
    this.imagined = detail.imagined.map(({ particles }) => particles && new ImaginedParticles(particles, this));
    this.home = gltf.cameras[0];
    this.reset();
    this.canvas.dataset.ready = "yes";
  }

  // Grid of 1 m lines on the floor, in segments of 1 m: software drivers drop long lines that pass
  // behind the camera.
  floor(height) {
    const points = [];
    for (let i = -6; i <= 6; i++) {
      for (let j = -6; j < 6; j++) points.push(i, j, height, i, j + 1, height, j, i, height, j + 1, i, height);
    }
    const corners = new Three.BufferAttribute(new Float32Array(points), 3);
    const geometry = new Three.BufferGeometry().setAttribute("position", corners);
    const lines = new Three.LineSegments(geometry, new Three.LineBasicMaterial());
    this.world.add(lines);
    return lines;
  }

  line(role, path) {
    const geometry = new Three.BufferGeometry().setAttribute("position", new Three.BufferAttribute(path, 3));
    const line = new Three.Line(geometry, new Three.LineBasicMaterial());
    line.frustumCulled = false;
    this.world.add(line);
    return { line, color: PATH_COLORS[role] };
  }

  points(positions, size) {
    const geometry = new Three.BufferGeometry().setAttribute("position", new Three.BufferAttribute(positions, 3));
    const points = new Three.Points(geometry, new Three.PointsMaterial({ size, sizeAttenuation: false }));
    points.frustumCulled = false;
    this.world.add(points);
    return points;
  }

  // The view of the trial's camera.
  reset() {
    this.home.updateWorldMatrix(true, false);
    this.home.getWorldPosition(this.camera.position);
    const { fov, near } = this.home;
    Object.assign(this.camera, { fov, near, far: 200 });
    this.controls.target.copy(this.world.localToWorld(new Three.Vector3(...this.home.userData.target)));
    this.controls.update();
    this.draw();
  }

  show(frame) {
    this.frame = frame;
    this.draw();
  }

  draw() {
    const { canvas, camera, renderer } = this;
    if (!this.world || this.closed || !canvas.clientWidth) return;
    const size = `${canvas.clientWidth} ${canvas.clientHeight}`;
    if (size !== this.size) {
      this.size = size;
      renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
    }
    camera.aspect = canvas.clientWidth / canvas.clientHeight;
    camera.updateProjectionMatrix();
    if (this.action) {
      this.action.time = this.frame * this.extras.frame_time;
      this.mixer.update(0);
    }
    this.world.traverse((node) => {
      if (node.userData.scenery) node.visible = this.scenery;
    });
    const style = getComputedStyle(canvas);
    const ends = Math.min(this.detail.frames, this.limit);
    for (const { line, color } of this.lines) {
      line.visible = this.paths;
      line.material.color.set(style.getPropertyValue(color).trim());
      line.geometry.setDrawRange(0, ends);
    }
    const touched = this.detail.touches.filter(([frame]) => frame <= this.frame && frame < ends).length;
    this.touches.visible = this.paths && touched > 0;
    this.touches.material.color.set(style.getPropertyValue("--mark").trim());
    this.touches.geometry.setDrawRange(0, touched);
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    let shown = false;
    this.imagined.forEach((particles, index) => {
      const visible = index === this.imaginedBy && this.frame >= (particles?.from ?? Infinity) && ends === this.detail.frames;
      particles?.show(visible, this.frame, dark);
      shown ||= visible;
    });
    for (const material of this.materials) {
      material.opacity = shown ? PALE : 1;
      material.depthWrite = !shown;
    }
    this.grid.material.color.set(dark ? 0x4a525d : 0xb4bac2);
    renderer.render(this.scene, camera);
  }

  // Turn the view about its target, in radians.
  orbit(across, up) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const spherical = new Three.Spherical().setFromVector3(offset);
    spherical.theta -= across;
    spherical.phi += up;
    this.camera.position.setFromSpherical(spherical.makeSafe()).add(this.controls.target);
    this.controls.update();
  }

  zoom(factor) {
    const { position } = this.camera;
    position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
  }

  pan(right, up) {
    const offset = new Three.Vector3(right, up, 0).applyQuaternion(this.camera.quaternion);
    offset.multiplyScalar(this.camera.position.distanceTo(this.controls.target));
    this.camera.position.add(offset);
    this.controls.target.add(offset);
    this.controls.update();
  }

  onKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || !this.world) return;
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

// Particles that a model imagined, at each frame after the observed part, one cloud for each object.
class ImaginedParticles {
  constructor({ from, frames, points, groups }, view) {
    this.from = from;
    this.frames = frames;
    this.positions = decodePoints(points);
    this.size = this.positions.length / frames.length;
    this.groups = groups.map(({ role, first, count }) => ({
      color: PARTICLE_COLORS[role], first, cloud: view.points(new Float32Array(3 * count), 3.5),
    }));
  }

  show(visible, frame, dark) {
    for (const { color, first, cloud } of this.groups) {
      cloud.visible = visible;
      if (!visible) continue;
      const grey = dark ? [0.78, 0.8, 0.84] : [0.3, 0.32, 0.36];
      cloud.material.color.setRGB(...(color ?? grey), Three.SRGBColorSpace);
      this.interpolate(frame, 3 * first, cloud.geometry.attributes.position);
    }
  }

  // Positions at a frame, linearly between the stored ones, and the last ones afterwards.
  interpolate(frame, start, attribute) {
    const { frames, positions, size } = this;
    let row = 0;
    while (row < frames.length - 2 && frames[row + 1] <= frame) row++;
    const next = Math.min(row + 1, frames.length - 1);
    const span = frames[next] - frames[row];
    const weight = span > 0 ? Math.min((frame - frames[row]) / span, 1) : 0;
    const { array } = attribute;
    for (let i = 0; i < array.length; i++) {
      array[i] = (1 - weight) * positions[row * size + start + i] + weight * positions[next * size + start + i];
    }
    attribute.needsUpdate = true;
  }
}
