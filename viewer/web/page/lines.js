// Lines of any width: bright where nothing is in front of them, dim where something is.

import { program, square, use } from "/gl.js";

const VERTEX = `
in vec2 corner;
in vec3 start;
in vec3 end;
in vec4 look; // red, green, blue, width in pixels
uniform float thick; // pixels of the picture for a pixel of width
uniform float strength;
out vec4 colour;
void main() {
  vec3 a = in_camera(start), b = in_camera(end);
  gl_Position = NOWHERE;
  if (max(a.z, b.z) < NEAR) return;
  if (a.z < NEAR) a = mix(a, b, (NEAR - a.z) / (b.z - a.z));
  if (b.z < NEAR) b = mix(b, a, (NEAR - b.z) / (a.z - b.z));
  vec2 from = pixel(a), to = pixel(b);
  vec2 along = normalize(to - from + vec2(1e-6, 0.0));
  float z = corner.x < 0.0 ? a.z : b.z;
  vec2 side = 0.5 * max(1.0, look.w * thick) * corner.y * vec2(-along.y, along.x);
  gl_Position = clip((corner.x < 0.0 ? from : to) + side, z);
  colour = vec4(look.rgb * strength, strength);
}`;

const FRAGMENT = `
in vec4 colour;
out vec4 shown;
void main() { shown = colour; }`;

const NUMBERS = 10; // of a line: its ends and its look

export class Lines {
  constructor(gl) {
    this.gl = gl;
    this.count = 0;
    this.program = program(gl, VERTEX, FRAGMENT);
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    square(gl, this.program.attribute("corner"));
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    for (const [name, size, at] of [["start", 3, 0], ["end", 3, 3], ["look", 4, 6]]) {
      const place = this.program.attribute(name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 4 * NUMBERS, 4 * at);
      gl.vertexAttribDivisor(place, 1);
    }
    gl.bindVertexArray(null);
  }

  /** The lines to draw: groups of {ends (six numbers a line), colour, width}. */
  set(groups) {
    this.count = groups.reduce((sum, { ends }) => sum + ends.length / 6, 0);
    const numbers = new Float32Array(NUMBERS * this.count);
    let to = 0;
    for (const { ends, colour, width } of groups) {
      for (let from = 0; from < ends.length; from += 6, to += NUMBERS) {
        numbers.set(ends.slice(from, from + 6), to);
        numbers.set([...colour, width], to + 6);
      }
    }
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, numbers, this.gl.DYNAMIC_DRAW);
  }

  /** Opaque among what hides them, or, once all else is drawn, dim over everything. */
  draw(eye, thick, dim) {
    const { gl } = this;
    use(gl, this.program, eye);
    gl.uniform1f(this.program.uniforms.thick, thick);
    gl.uniform1f(this.program.uniforms.strength, dim ? 0.25 : 1);
    gl.bindVertexArray(this.array);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (dim) gl.disable(gl.DEPTH_TEST);
    else gl.enable(gl.DEPTH_TEST);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.bindVertexArray(null);
  }
}
