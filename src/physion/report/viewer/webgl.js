// The little of WebGL 2 that the 3D view needs: two programs, and vertices on the card.

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
