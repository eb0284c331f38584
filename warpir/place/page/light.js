// The light on the page: the user's sun and sky, else what is estimated from the photo.

import { clamp, cross, dot, project, sunAxis } from './camera.js';
import { follow, shape } from './handles.js';

const LUMINANCE = [0.2126, 0.7152, 0.0722];
const ELEVATION = 45; // of a sun whose azimuth alone was typed
const RADIUS = 46; // of the dial
const LEAST_FROM_AFAR = 0.05; // of the ground's light, whatever lamps near it give
const PATIENCE = 1200; // ms that a camera must rest before the light is estimated for it


// What a lamp near the object sends toward a point: the irradiance of what faces it at 1 m, RGB. A
// rectangle shines on one side, and less aslant.
export function lampStrength({ center, edge_x: a, edge_y: b, power, color }, point) {
  const all = color.map((part) => (part * power) / (4 * Math.PI));
  if (!a) return all;
  const offset = point.map((part, k) => part - center[k]);
  const normal = cross(a, b);
  const cosine = dot(normal, offset) / (Math.hypot(...normal) * Math.hypot(...offset) || 1);
  return all.map((part) => 4 * part * Math.max(cosine, 0));
}

// Luminance of what they give the ground at the object's foot.
function fromLamps({ lamps, stand }) {
  const given = lamps.map((lamp) => {
    const foot = [stand.x, 0, stand.z];
    const away = Math.hypot(...foot.map((part, k) => part - lamp.center[k]));
    return (dot(lampStrength(lamp, foot), LUMINANCE) * Math.max(lamp.center[1], 0)) / away ** 3 || 0;
  });
  return given.reduce((sum, part) => sum + part, 0);
}

// Codes of the photo, small.
export async function photoPixels(photo) {
  await photo.decode();
  const width = Math.min(512, photo.naturalWidth);
  const height = Math.max(1, Math.round((width * photo.naturalHeight) / photo.naturalWidth));
  const brush = Object.assign(document.createElement('canvas'), { width, height })
    .getContext('2d', { willReadFrequently: true });
  brush.drawImage(photo, 0, 0, width, height);
  return { width, height, codes: brush.getImageData(0, 0, width, height).data };
}

export class Lighting {
  // Of `work.py`: what the photo shows; null until it is known.
  estimate = null;
  problem = '';
  #asked = '';
  #timer = 0;

  // `page` has state, changed() and ask(camera), which returns an estimate.
  constructor(start, pixels, page) {
    Object.assign(this, { start, pixels, page });
  }

  // The light with which the page starts: the flags', or one that counts only once it is changed.
  opening() {
    const { sun, sky, keeps_light: isKept, sun_to_sky: usual } = this.start;
    const custom = Array.isArray(sky) ? sky : null;
    const light = { sky: custom ? 'custom' : sky, custom, skyStrength: 1, isKept };
    const [azimuth, elevation, strength] = sun ?? [null, null, 0];
    return { ...light, azimuth, elevation, sunStrength: strength === null ? usual : strength / this.#unit(light) };
  }

  #radiance(light) {
    return light.sky === 'custom' ? light.custom : this.start.sky_radiance[light.sky];
  }

  // A sun's strength counts in what the sky gives on the ground; under a black one as --sun has it.
  #unit(light) {
    return Math.PI * dot(this.#radiance(light), LUMINANCE) || 1;
  }

  // Sun and sky as they are shown: those that are saved, else the estimate.
  shown({ light }) {
    if (light.isKept || !this.estimate) return light;
    const { direction, sun, sky } = this.estimate;
    const like = { ...light, sky: 'custom', custom: sky, skyStrength: 1 };
    const [azimuth, elevation] = direction ?? [null, null];
    return { ...like, azimuth, elevation, sunStrength: direction ? dot(sun, LUMINANCE) / this.#unit(like) : 0 };
  }

  // The same with the light changed, which the user wants from then on.
  set(before, change) {
    const light = { ...this.shown(before), isKept: true, ...change };
    if (light.sky === 'custom') light.custom ??= this.estimate.sky; // chosen for a light of before it
    if (light.azimuth !== null || light.elevation !== null) {
      light.azimuth ??= 0;
      light.elevation ??= ELEVATION;
      if (change.sunStrength === undefined) light.sunStrength ||= this.start.sun_to_sky;
    }
    return { ...before, light };
  }

  // Values of --sun and --sky. Only the proportion counts: the exposure follows.
  saved({ light }) {
    if (!light.isKept) return { sun: null, sky: null };
    const strength = (light.sunStrength * this.#unit(light)) / light.skyStrength;
    const isSunny = light.azimuth !== null && strength > 0;
    return {
      sun: isSunny ? [light.azimuth, light.elevation, strength] : null,
      sky: light.sky === 'custom' ? light.custom : light.sky,
    };
  }

  // Irradiances and radiances in the photo's unit, for the stage.
  onStage(state) {
    const { estimate } = this;
    if (estimate && !state.light.isKept) {
      const { direction, sun, sky, bounce } = estimate;
      const axis = this.#inGround(sunAxis(...(direction ?? [0, 90])));
      const fromSun = dot(sun, LUMINANCE) * Math.max(axis[1], 0);
      const total = Math.PI * dot(sky, LUMINANCE) + fromSun || 1;
      return { axis, sun, sky, bounce, sunShare: fromSun / (total + fromLamps(state)) };
    }
    return this.#described(state);
  }

  #inGround(world) {
    const rows = this.start.ground_to_world;
    return [0, 1, 2].map((k) => dot(rows.slice(0, 3).map((row) => row[k]), world));
  }

  // Sun and sky as warpir/lighting/scene_light.py makes them of --sun and --sky, at its automatic exposure.
  #described(state) {
    const { light } = state;
    const { ground_albedo: albedo, sun_color: colors } = this.start;
    const radiance = this.#radiance(light).map((part) => part * light.skyStrength);
    const color = colors[light.sky] ?? colors.clear;
    const strength = light.azimuth === null ? 0 : light.sunStrength * this.#unit(light);
    const sun = color.map((part) => (strength * part) / dot(color, LUMINANCE));
    const world = sunAxis(light.azimuth ?? 0, light.elevation ?? 90);
    const axis = this.#inGround(world);
    const fromSun = dot(sun, LUMINANCE) * Math.max(axis[1], 0);
    const total = Math.PI * dot(radiance, LUMINANCE) + fromSun || 1; // of no light there are no shares
    const received = (this.groundLevel(state) * Math.PI) / albedo;
    const near = fromLamps(state);
    const left = Math.max(received - near, LEAST_FROM_AFAR * received);
    const gain = left / total;
    const bounce = [0, 1, 2].map((k) =>
      (albedo / Math.PI) * (Math.PI * radiance[k] + sun[k] * Math.max(world[1], 0)));
    const scaled = (parts) => parts.map((part) => part * gain);
    return { axis, sun: scaled(sun), sky: scaled(radiance), bounce: scaled(bounce), sunShare: ((fromSun / total) * left) / (left + near) };
  }

  // Luminance of the photo's lit ground round the object, as warpir/lighting/scene_light.py measures it.
  groundLevel({ camera, stance, stand, size }) {
    const { asset } = this.start;
    const { width, height, codes } = this.pixels;
    const sides = asset.high.map((top, k) => top - asset.low[k]);
    const reach = (size * Math.hypot(...sides)) / Math.max(...sides);
    const levels = [];
    for (let ring = 0; ring < 16; ring += 1) {
      for (let k = 0; k < 32; k += 1) {
        const [radius, angle] = [reach * (0.2 + (1.3 * ring) / 15), (k * Math.PI) / 16];
        const point = [stand.x + radius * Math.cos(angle), 0, stand.z + radius * Math.sin(angle)];
        const [u, v] = project(camera, stance, point) ?? [-1, -1];
        const column = Math.floor((u * width) / camera.width);
        const row = Math.floor((v * height) / camera.height);
        if (column < 0 || row < 0 || column >= width || row >= height) continue;
        const first = 4 * (row * width + column);
        const linear = [0, 1, 2].map((c) => (codes[first + c] / 255) ** 2.2);
        levels.push(dot(linear, LUMINANCE));
      }
    }
    if (!levels.length) return 0.25;
    levels.sort((a, b) => a - b);
    return clamp(levels[Math.floor(0.75 * (levels.length - 1))], 1e-3, 0.9);
  }

  // Ask for the light that a camera shows, where it counts and is not known yet.
  follow({ light, camera, stance }) {
    const asked = JSON.stringify([camera, { ...stance, x: 0, z: 0, height: 0 }]);
    if (light.isKept || asked === this.#asked) return;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(async () => {
      this.#asked = asked;
      try {
        const found = await this.page.ask({ camera, stance });
        if (asked === this.#asked) Object.assign(this, { estimate: found, problem: '' });
      } catch (error) {
        this.problem = error.message;
      }
      this.page.changed();
    }, this.#asked ? PATIENCE : 0);
  }

  // Where the shown light comes from: `own`, `problem`, `pending`, `estimate` or `unclear`.
  get source() {
    if (this.page.state.light.isKept) return 'own';
    if (this.problem) return 'problem';
    if (!this.estimate) return 'pending';
    return this.estimate.direction ? 'estimate' : 'unclear';
  }

  // What is to be said of the light, in words.
  get words() {
    const { estimate, problem, source } = this;
    if (source === 'own') return 'Yours: it is saved.';
    if (source === 'problem') return `Not estimated: ${problem}`;
    if (source === 'pending') return 'Estimating the light of the photo …';
    const spread = Math.round(estimate.spread_deg);
    if (source === 'unclear') {
      return `Estimated from the photo: no clear direction (± ${spread}°), so none is drawn. Click the dial if you know one.`;
    }
    const [azimuth, elevation] = estimate.direction.map(Math.round);
    const factor = Math.exp(estimate.sun_log_std).toFixed(1);
    const origin = estimate.sun_in_view === null ? 'Estimated from the photo' : 'The photo shows the sun';
    const amount = spread ? ` ± ${spread}°` : ' ± 1°';
    return `${origin}: azimuth ${azimuth}°, elevation ${elevation}°,${amount}; strength within a factor of ${factor}.`;
  }
}

// The dial: the sun seen from above, ahead is up, the rim is the horizon.
export class Dial {
  constructor(svg, lighting, history) {
    Object.assign(this, { svg, lighting, history });
    for (const [kind, radius] of [['sky', RADIUS], ['ring', (RADIUS * 2) / 3], ['ring', RADIUS / 3]]) {
      svg.append(shape('circle', { class: kind, r: radius }));
    }
    svg.append(shape('text', { x: 0, y: -50 }, 'ahead'), shape('text', { x: 0, y: 58 }, 'behind'));
    this.doubt = svg.appendChild(shape('path', { class: 'doubt' }));
    this.sun = svg.appendChild(shape('circle', { class: 'sun', r: 6 }));
    svg.addEventListener('pointerdown', (event) => {
      if (follow(svg, event, history, 'dial', (moved) => this.#point(moved))) this.#point(event);
    });
  }

  #point({ clientX, clientY }) {
    const box = this.svg.getBoundingClientRect();
    const [x, y] = [((clientX - box.left) / box.width) * 120 - 60, ((clientY - box.top) / box.height) * 120 - 60];
    const turn = (Math.atan2(x, -y) * 180) / Math.PI - this.history.state.stance.heading;
    const azimuth = ((((turn + 180) % 360) + 360) % 360) - 180;
    const elevation = 90 * (1 - Math.min(Math.hypot(x, y) / RADIUS, 1));
    this.history.move((before) => this.lighting.set(before, { azimuth, elevation }));
  }

  #at(azimuth, elevation, heading) {
    const angle = ((azimuth + heading) * Math.PI) / 180;
    const radius = RADIUS * clamp(1 - elevation / 90, 0, 1.1);
    return [radius * Math.sin(angle), -radius * Math.cos(angle)];
  }

  draw(state) {
    const { azimuth, elevation } = this.lighting.shown(state);
    const { heading } = state.stance;
    const isEstimate = !state.light.isKept;
    this.sun.style.display = azimuth === null ? 'none' : '';
    this.doubt.style.display = azimuth === null || !isEstimate ? 'none' : '';
    this.sun.classList.toggle('estimate', isEstimate);
    if (azimuth === null) return;
    const [x, y] = this.#at(azimuth, elevation, heading);
    this.sun.setAttribute('cx', x);
    this.sun.setAttribute('cy', y);
    if (isEstimate) this.doubt.setAttribute('d', `M${this.#around(azimuth, elevation, heading).join('L')}Z`);
  }

  // The circle on the sky that is as far from a direction as the truth is expected to be.
  #around(azimuth, elevation, heading) {
    const spread = (Math.max(this.lighting.estimate?.spread_deg ?? 0, 1) * Math.PI) / 180;
    const axis = sunAxis(azimuth, elevation);
    const level = Math.hypot(axis[0], axis[2]) || 1;
    const across = [-axis[2] / level, 0, axis[0] / level];
    const along = cross(axis, across);
    return Array.from({ length: 49 }, (_, k) => {
      const [c, s] = [Math.cos((k * Math.PI) / 24), Math.sin((k * Math.PI) / 24)];
      const d = axis.map((part, i) => Math.cos(spread) * part + Math.sin(spread) * (c * across[i] + s * along[i]));
      const [a, e] = [Math.atan2(d[0], -d[2]), Math.asin(clamp(d[1], -1, 1))].map((angle) => (angle * 180) / Math.PI);
      return this.#at(a, Math.max(e, 0), heading);
    });
  }
}
