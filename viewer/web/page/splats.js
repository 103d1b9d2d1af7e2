// The Gaussians: each an ellipse as the project's rasteriser defines it, drawn from the farthest to the nearest.

import { program, use } from "/gl.js";

const BATCH = 512; // Gaussians drawn as one instance: instances of four corners each would leave processors idle

const VERTEX = `
uniform usampler2D gaussians;
uniform usampler2D order; // the numbers of the Gaussians, the farthest first
uniform int count;
uniform float point_size; // pixels; 0: as Gaussians
out vec4 colour;
out vec2 at; // in standard deviations
const float BLUR = 0.3; // pixels squared: what a pixel's own extent adds
void main() {
  gl_Position = NOWHERE;
  int place = gl_InstanceID * ${BATCH} + gl_VertexID / 4;
  if (place >= count) return;
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  uint number = texelFetch(order, ivec2(place & 1023, place >> 10), 0).x;
  ivec2 texel = ivec2(3u * (number & 1023u), number >> 10);
  uvec4 one = texelFetch(gaussians, texel, 0);
  vec3 p = in_camera(uintBitsToFloat(one.xyz));
  uint rgba = one.w;
  colour = vec4(rgba & 255u, (rgba >> 8) & 255u, (rgba >> 16) & 255u, rgba >> 24) / 255.0;
  if (p.z < NEAR || colour.a < 1.0 / 255.0) return;
  if (point_size > 0.0) {
    at = vec2(0.0);
    colour.a = 1.0;
    gl_Position = clip(pixel(p) + 0.5 * point_size * corner, p.z);
    return;
  }
  vec4 s = uintBitsToFloat(texelFetch(gaussians, texel + ivec2(1, 0), 0));
  vec2 s2 = uintBitsToFloat(texelFetch(gaussians, texel + ivec2(2, 0), 0).xy);
  mat3 world = mat3(s.x, s.y, s.z, s.y, s.w, s2.x, s.z, s2.x, s2.y);
  // The projection's derivative there, with the slope bounded: far outside the picture it would explode.
  vec2 most = 0.65 * size / K.xy;
  vec2 slope = clamp(p.xy / p.z, -most, most);
  vec3 right = vec3(K.x / p.z, 0.0, -K.x * slope.x / p.z) * mat3(T_camera_world);
  vec3 down = vec3(0.0, K.y / p.z, -K.y * slope.y / p.z) * mat3(T_camera_world);
  float xx = dot(right, world * right) + BLUR, xy = dot(right, world * down), yy = dot(down, world * down) + BLUR;
  float middle = 0.5 * (xx + yy), off = length(vec2(0.5 * (xx - yy), xy));
  vec2 deviations = sqrt(vec2(middle + off, max(middle - off, 0.1)));
  vec2 axis = abs(xy) > 1e-6 ? normalize(vec2(xy, middle + off - xx)) : xx >= yy ? vec2(1, 0) : vec2(0, 1);
  at = corner * sqrt(2.0 * log(255.0 * colour.a)); // beyond it, less than 1/255 is left
  vec2 offset = at.x * deviations.x * axis + at.y * deviations.y * vec2(-axis.y, axis.x);
  gl_Position = clip(pixel(p) + offset, p.z);
}`;

const FRAGMENT = `
in vec4 colour;
in vec2 at;
out vec4 shown;
void main() {
  float alpha = colour.a * exp(-0.5 * dot(at, at));
  if (alpha < 1.0 / 255.0) discard;
  shown = vec4(colour.rgb * alpha, alpha);
}`;

export class Splats {
  /** `changed(version)` is called when there is something else to draw. */
  constructor(gl, changed) {
    this.gl = gl;
    this.count = 0;
    this.version = 0; // of what is drawn
    this.changed = changed;
    this.program = program(gl, VERTEX, FRAGMENT);
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const triangles = Array.from({ length: BATCH }, (_, i) => [0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner));
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(triangles.flat()), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.textures = { gaussians: gl.createTexture(), order: gl.createTexture() };
    this.sorting = false;
    this.asked = null; // the direction of the last sort
    this.worker = new Worker("/sort_worker.js");
    this.worker.onmessage = ({ data }) => this.#take(data);
  }

  /** Draws the Gaussians of a .splat file from when they are ready on. */
  load(file, version, direction) {
    this.asked = direction;
    this.sorting = true;
    this.worker.postMessage({ file, version, direction }, [file]);
  }

  /** Asks for the order along `direction`, if it is another one and the last answer has come. */
  sort(direction) {
    const same = this.asked && this.asked.every((value, i) => Math.abs(value - direction[i]) < 1e-4);
    if (this.sorting || same || !this.count) return;
    this.asked = direction;
    this.sorting = true;
    this.worker.postMessage({ direction });
  }

  draw(eye, pointSize) {
    if (!this.count) return;
    const { gl } = this;
    use(gl, this.program, eye);
    gl.uniform1f(this.program.uniforms.point_size, pointSize);
    gl.uniform1i(this.program.uniforms.count, this.count);
    Object.entries(this.textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(this.program.uniforms[name], unit);
    });
    gl.activeTexture(gl.TEXTURE0);
    gl.bindVertexArray(this.array);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(pointSize > 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.count / BATCH));
    gl.depthMask(true);
    gl.bindVertexArray(null);
  }

  #take({ version, texture, order, count, width }) {
    const { gl } = this;
    this.sorting = false;
    if (texture) {
      this.#fill(this.textures.gaussians, gl.RGBA32UI, gl.RGBA_INTEGER, 3 * width, texture.length / (12 * width), texture);
      this.version = version;
    } else if (version !== this.version) return; // an order of what is no longer drawn
    this.#fill(this.textures.order, gl.R32UI, gl.RED_INTEGER, width, order.length / width, order);
    this.count = count;
    this.changed(Boolean(texture));
  }

  #fill(texture, kind, format, width, height, numbers) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, kind, width, height, 0, format, gl.UNSIGNED_INT, numbers);
  }
}
