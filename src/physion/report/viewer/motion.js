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

// A grid of metres, in pieces of one: software drivers drop long lines that pass the camera.
function floorLines(height) {
  const points = [];
  for (let i = -6; i <= 6; i++) {
    for (let j = -6; j < 6; j++) points.push(i, j, height, i, j + 1, height, j, i, height, j + 1, i, height);
  }
  return new Float32Array(points);
}
