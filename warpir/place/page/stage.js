// The picture over the photo: object, its shadow and the ground's grid, by three.js.

import * as THREE from 'three';
import { GLTFLoader } from './vendor/loaders/GLTFLoader.js';
import { placed, pose, projection } from './camera.js';
import { lampStrength } from './light.js';

const SHADOW_SIDE = 2048;
const SKY_DIRECTIONS = 48; // from which the ground's view of the sky is measured
const SKY_PER_FRAME = 8;
const SKY_SIDE = 128; // texels of that measurement, for SKY_REACH times the object's size
const SKY_REACH = 3;
const GRID_REACH = 400; // camera heights

// Ground that is darkened: by what part of the sun and of the sky reaches it, display-encoded as
// warpir composites, photo ** 2.2 times the ratio.
const SHADOW_VERTEX = ['#include <common>', `#include <common>
varying vec3 vGround;`, '#include <begin_vertex>', `#include <begin_vertex>
vGround = (modelMatrix * vec4(position, 1.0)).xyz;`];
const SHADOW_FRAGMENT = ['#include <common>', `#include <common>
uniform mat4 groundToSky; uniform sampler2D skyHidden; uniform float sunShare;
varying vec3 vGround;`, 'gl_FragColor = vec4( color, opacity * ( 1.0 - getShadowMask() ) );', `
vec2 uv = (groundToSky * vec4(vGround, 1.0)).xz;
bool isNear = all(greaterThan(uv, vec2(0.0))) && all(lessThan(uv, vec2(1.0)));
float sky = isNear ? 1.0 - texture2D(skyHidden, uv).a : 1.0;
float ratio = sunShare * getShadowMask() + (1.0 - sunShare) * sky;
gl_FragColor = vec4(vec3(0.0), 1.0 - pow(clamp(ratio, 0.0, 1.0), 1.0 / 2.2));`];

// Lines of one pixel in white with a dark rim, so that they show on snow and on asphalt.
const GRID_FRAGMENT = `
uniform float spacing; uniform vec2 center; uniform float reach; varying vec2 vGround;
float lines(vec2 p, vec2 pixel, float width) {
  vec2 away = abs(fract(p - 0.5) - 0.5) / pixel;
  vec2 line = clamp(width + 0.5 - away, 0.0, 1.0) * clamp(0.35 / pixel - 0.4, 0.0, 1.0);
  return max(line.x, line.y);
}
void main() {
  vec2 p = vGround / spacing;
  vec2 pixel = fwidth(p);
  float fade = 1.0 - smoothstep(0.2, 1.0, length(vGround - center) / reach);
  float white = max(0.62 * lines(p, pixel, 0.5), 0.85 * lines(p / 5.0, pixel / 5.0, 0.7));
  float dark = 0.4 * max(lines(p, pixel, 1.6), lines(p / 5.0, pixel / 5.0, 1.9));
  float alpha = white + dark * (1.0 - white);
  gl_FragColor = vec4(vec3(white), alpha) * fade;
}`;
const GRID_VERTEX = `
varying vec2 vGround;
void main() {
  vec4 p = modelMatrix * vec4(position, 1.0);
  vGround = p.xz;
  gl_Position = projectionMatrix * viewMatrix * p;
}`;

export class Stage {
  constructor(canvas) {
    this.renderer = new THREE.WebGLRenderer({ canvas, alpha: true, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFShadowMap;
    this.renderer.toneMapping = THREE.NoToneMapping;
    this.scene = new THREE.Scene();
    this.camera = new THREE.Camera();
    this.camera.matrixAutoUpdate = false;
    this.object = new THREE.Group();
    this.object.matrixAutoUpdate = false;
    this.sun = new THREE.DirectionalLight();
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(SHADOW_SIDE, SHADOW_SIDE);
    this.sun.shadow.radius = 2;
    this.lamps = [];
    this.scene.add(this.object, this.sun, this.sun.target);
    this.pmrem = new THREE.PMREMGenerator(this.renderer);
    this.skyTarget = new THREE.WebGLRenderTarget(SKY_SIDE, SKY_SIDE, { type: THREE.HalfFloatType });
    this.skyDone = 0;
    this.ground = this.#makeGround();
    this.grid = this.#makeGrid();
    this.scene.add(this.ground, this.grid);
  }

  #makeGround() {
    const material = new THREE.ShadowMaterial({ depthWrite: false });
    this.groundUniforms = {
      groundToSky: { value: new THREE.Matrix4() },
      skyHidden: { value: this.skyTarget.texture },
      sunShare: { value: 0.5 },
    };
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, this.groundUniforms);
      const [a, b, c, d] = SHADOW_VERTEX;
      shader.vertexShader = shader.vertexShader.replace(a, b).replace(c, d);
      const [e, f, g, h] = SHADOW_FRAGMENT;
      shader.fragmentShader = shader.fragmentShader.replace(e, f).replace(g, h);
    };
    const ground = new THREE.Mesh(new THREE.PlaneGeometry(2, 2).rotateX(-Math.PI / 2), material);
    ground.receiveShadow = true;
    ground.renderOrder = -1;
    return ground;
  }

  #makeGrid() {
    this.gridUniforms = {
      spacing: { value: 1 },
      center: { value: new THREE.Vector2() },
      reach: { value: 1 },
    };
    const material = new THREE.ShaderMaterial({
      vertexShader: GRID_VERTEX,
      fragmentShader: GRID_FRAGMENT,
      uniforms: this.gridUniforms,
      transparent: true,
      premultipliedAlpha: true,
      blending: THREE.CustomBlending,
      blendSrc: THREE.OneFactor,
      blendDst: THREE.OneMinusSrcAlphaFactor,
      depthWrite: false,
      side: THREE.DoubleSide,
    });
    const geometry = new THREE.PlaneGeometry(2, 2).rotateX(-Math.PI / 2);
    const grid = new THREE.Mesh(geometry, material);
    grid.frustumCulled = false;
    return grid;
  }

  // Read the asset; `box` is its bounding box in its own frame.
  async load(address, box) {
    const glb = await new GLTFLoader().loadAsync(address);
    this.box = box;
    this.side = Math.max(...box.high.map((top, k) => top - box.low[k]));
    glb.scene.traverse((part) => {
      part.castShadow = part.receiveShadow = Boolean(part.isMesh);
      part.frustumCulled = false;
      // One-sided surfaces hide light from both sides in warpir, too.
      if (part.isMesh) part.material.shadowSide = THREE.DoubleSide;
    });
    this.object.add(glb.scene);
    this.#prepareSky(glb.scene);
  }

  // Show a part of the photo, in its pixels, at a size on the screen.
  setWindow(seen, width, height, ratio) {
    this.window = seen;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
  }

  setCamera(camera, stance) {
    this.camera.matrix.fromArray(pose(stance));
    this.camera.matrixWorld.copy(this.camera.matrix);
    this.camera.matrixWorldInverse.copy(this.camera.matrix).invert();
    this.view = { camera, height: stance.height };
    const spacing = 10 ** Math.round(Math.log10(stance.height / 1.6));
    const reach = GRID_REACH * stance.height;
    this.grid.position.set(stance.x, 0, stance.z);
    this.grid.scale.setScalar(reach);
    this.gridUniforms.spacing.value = spacing;
    this.gridUniforms.center.value.set(stance.x, stance.z);
    this.gridUniforms.reach.value = 60 * spacing;
    return spacing;
  }

  setObject(stand, turn, size) {
    this.object.matrix.fromArray(placed(this.box, stand, turn, size));
    this.object.updateMatrixWorld(true);
    const { low, high } = this.box;
    const middle = low.map((bottom, k) => (bottom + high[k]) / 2);
    this.middle = new THREE.Vector3(...middle).applyMatrix4(this.object.matrix);
    const scale = size / this.side;
    this.radius = (scale * Math.hypot(...high.map((top, k) => top - low[k]))) / 2;
    // Into the texture of what hides the sky: SKY_REACH sizes wide, the foot in its middle.
    const toSky = new THREE.Matrix4().makeTranslation(0.5, 0, 0.5);
    toSky.multiply(new THREE.Matrix4().makeScale(1 / (SKY_REACH * this.side), 1, -1 / (SKY_REACH * this.side)));
    const foot = new THREE.Matrix4().makeTranslation(-middle[0], 0, -middle[2]);
    toSky.multiply(foot).multiply(this.object.matrix.clone().invert());
    this.groundUniforms.groundToSky.value.copy(toSky);
  }

  // `axis` toward the sun in the ground frame; irradiances and radiances as warpir's, at the
  // photo's exposure; `sunShare` of the ground's light comes from the sun.
  setLight({ axis, sun, sky, bounce, sunShare }) {
    this.axis = new THREE.Vector3(...axis);
    this.sun.visible = axis[1] > 0 && Math.max(...sun) > 0;
    const strongest = Math.max(...sun, 1e-9);
    this.sun.color.setRGB(...sun.map((part) => part / strongest));
    this.sun.intensity = strongest;
    this.groundUniforms.sunShare.value = sunShare;
    const level = Math.max(...sky, ...bounce, 1e-9);
    this.scene.environmentIntensity = level;
    const colors = [...sky, ...bounce].map((part) => part / level);
    // The filtered map depends on the colours' proportions only, and takes a while.
    const key = colors.map((part) => part.toFixed(2)).join();
    if (key !== this.skyKey) this.#makeEnvironment(colors);
    this.skyKey = key;
  }

  // Lamps near the object, as the page's state has them: they light it without a shadow.
  setLamps(lamps) {
    while (this.lamps.length < lamps.length) this.lamps.push(new THREE.PointLight());
    for (const [k, light] of this.lamps.entries()) {
      const lamp = lamps[k];
      if (!lamp) {
        this.scene.remove(light);
        continue;
      }
      this.scene.add(light);
      light.position.set(...lamp.center);
      light.color.setRGB(...lampStrength(lamp, this.middle.toArray()));
    }
  }

  #makeEnvironment(colors) {
    // The least that three.js filters: 16 texels per face of its cube. Row 0 is the lower edge.
    const [width, height] = [64, 32];
    const texels = Float32Array.from({ length: width * height * 4 }, (_, k) => {
      const from = k < (width * height * 4) / 2 ? 3 : 0;
      return k % 4 === 3 ? 1 : colors[from + (k % 4)];
    });
    const map = new THREE.DataTexture(texels, width, height, THREE.RGBAFormat, THREE.FloatType);
    map.mapping = THREE.EquirectangularReflectionMapping;
    map.needsUpdate = true;
    this.environment?.dispose();
    this.environment = this.pmrem.fromEquirectangular(map);
    this.scene.environment = this.environment.texture;
    map.dispose();
  }

  #aimSun() {
    const { radius, middle, axis } = this;
    const low = Math.max(axis.y, 0.03);
    this.sun.position.copy(middle).addScaledVector(axis, 2 * radius);
    this.sun.target.position.copy(middle);
    this.sun.target.updateMatrixWorld();
    const lens = this.sun.shadow.camera;
    [lens.left, lens.right, lens.top, lens.bottom] = [-radius, radius, radius, -radius];
    [lens.near, lens.far] = [radius * 0.5, 3 * radius + (2 * radius) / low];
    lens.updateProjectionMatrix();
    this.sun.shadow.normalBias = radius / 300;
    const reach = radius * Math.min(4 + 2 / low, 60);
    this.ground.position.set(middle.x, 0, middle.z);
    this.ground.scale.setScalar(Math.max(reach, SKY_REACH * radius * 2));
  }

  // How much of the sky the object hides from the ground round it depends on its shape alone: it
  // is measured once, by shadows from directions spread with the cosine over the hemisphere.
  #prepareSky(model) {
    const scene = new THREE.Scene();
    const { low, high } = this.box;
    const { side } = this;
    const reach = SKY_REACH * side;
    const hidden = new THREE.MeshBasicMaterial({ colorWrite: false, depthWrite: false });
    hidden.shadowSide = THREE.DoubleSide;
    const caster = model.clone();
    caster.traverse((part) => {
      if (part.isMesh) part.material = hidden;
    });
    const material = new THREE.ShadowMaterial({ opacity: 1 / SKY_DIRECTIONS });
    Object.assign(material, {
      blending: THREE.AdditiveBlending, premultipliedAlpha: true, depthTest: false,
    });
    const geometry = new THREE.PlaneGeometry(reach, reach).rotateX(-Math.PI / 2);
    const ground = new THREE.Mesh(geometry, material);
    const middle = low.map((bottom, k) => (bottom + high[k]) / 2);
    ground.position.set(middle[0], low[1], middle[2]);
    ground.receiveShadow = true;
    const radius = Math.hypot(...high.map((top, k) => top - low[k])) / 2;
    const light = new THREE.DirectionalLight();
    light.castShadow = true;
    light.shadow.mapSize.set(256, 256);
    light.shadow.radius = 3;
    light.target.position.set(...middle);
    const lens = light.shadow.camera;
    [lens.left, lens.right, lens.top, lens.bottom] = [-radius, radius, radius, -radius];
    [lens.near, lens.far] = [radius * 0.5, radius * 3 + reach];
    const camera = new THREE.OrthographicCamera(-reach / 2, reach / 2, reach / 2, -reach / 2, 0, 4);
    camera.position.set(middle[0], low[1] + 2, middle[2]);
    camera.rotation.x = -Math.PI / 2;
    scene.add(caster, ground, light, light.target);
    this.skyDone = 0;
    this.skyStep = () => {
      // Malley's method on a spiral of the golden angle.
      const share = (this.skyDone + 0.5) / SKY_DIRECTIONS;
      const angle = this.skyDone * Math.PI * (3 - Math.sqrt(5));
      const flat = Math.sqrt(share);
      const axis = [flat * Math.cos(angle), Math.sqrt(1 - share), flat * Math.sin(angle)];
      light.position.set(...middle.map((part, k) => part + 2 * radius * axis[k]));
      const { renderer } = this;
      renderer.setRenderTarget(this.skyTarget);
      renderer.autoClear = false;
      if (this.skyDone === 0) {
        renderer.setClearColor(0, 0);
        renderer.clear();
      }
      renderer.render(scene, camera);
      renderer.autoClear = true;
      renderer.setRenderTarget(null);
      this.skyDone += 1;
    };
  }

  // Draw; returns whether there is more to do although nothing has changed.
  render() {
    for (let k = 0; k < SKY_PER_FRAME && this.skyDone < SKY_DIRECTIONS; k += 1) this.skyStep();
    const away = this.middle.clone().applyMatrix4(this.camera.matrixWorldInverse).z * -1;
    const { camera, height } = this.view;
    const near = Math.max(Math.min(0.05 * height, 0.5 * (away - this.radius)), 1e-3 * height);
    const far = 2 * GRID_REACH * height + 2 * (Math.abs(away) + this.radius);
    const { x, y, width, height: rows } = this.window;
    const seen = { ...camera, width, height: rows, cx: camera.cx - x, cy: camera.cy - y };
    this.camera.projectionMatrix.fromArray(projection(seen, near, far));
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
    this.#aimSun();
    this.renderer.render(this.scene, this.camera);
    return this.skyDone < SKY_DIRECTIONS;
  }
}
