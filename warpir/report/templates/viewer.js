"use strict";
// The object on the photo: three.js, the object and the light are in this page, compressed.
const SIDE = 1024; // texels of the shadow's picture
const DEPTHS = [2048, 256]; // of a direction's depth, where it is a sun and where it is one of many
const LARGE = 0.1; // share of the light that makes a direction a sun
const REACH = 5; // of that picture, in radii of the object
const PER_FRAME = 8;

const element = (id) => document.getElementById(id);
const scene = JSON.parse(element("scene").textContent);

async function unpack(name) {
  const packed = Uint8Array.from(atob(element("data-" + name).textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

// Modules from this page import each other by the addresses that they get here.
async function module(name, replaced) {
  let text = new TextDecoder().decode(await unpack(name));
  for (const [from, to] of Object.entries(replaced)) text = text.replaceAll(from, JSON.stringify(to));
  return URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}

// OpenGL's projection with the photo's focal lengths and principal point, column by column.
function projection({ w, h, fx, fy, cx, cy }, near, far) {
  return [
    (2 * fx) / w, 0, 0, 0,
    0, (2 * fy) / h, 0, 0,
    1 - (2 * cx) / w, (2 * cy) / h - 1, -(far + near) / (far - near), -1,
    0, 0, (-2 * far * near) / (far - near), 0,
  ];
}

function skyMap(THREE, codes) {
  const rows = scene.rows;
  const texels = new Float32Array(rows * rows * 8);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < 2 * rows; column++) {
      const from = 4 * (row * 2 * rows + column);
      const to = 4 * ((rows - 1 - row) * 2 * rows + column); // a texture's first row is the lowest
      const unit = codes[from + 3] ? 2 ** (codes[from + 3] - 136) : 0;
      for (let c = 0; c < 3; c++) texels[to + c] = (codes[from + c] + 0.5) * unit;
      texels[to + 3] = 1;
    }
  }
  const map = new THREE.DataTexture(texels, 2 * rows, rows, THREE.RGBAFormat, THREE.FloatType);
  map.mapping = THREE.EquirectangularReflectionMapping;
  map.magFilter = map.minFilter = THREE.LinearFilter;
  map.needsUpdate = true;
  return map;
}

// What the object takes of the ground's light, colour by colour, summed direction by direction.
function shadowPicture(THREE, renderer, object, normal, foot) {
  const { radius } = scene;
  const target = new THREE.WebGLRenderTarget(SIDE, SIDE, { type: THREE.HalfFloatType });
  const right = new THREE.Vector3(1, 0, 0);
  if (Math.abs(normal.x) > 0.9) right.set(0, 0, 1);
  right.addScaledVector(normal, -right.dot(normal)).normalize();
  const ahead = new THREE.Vector3().crossVectors(normal, right);
  const turn = new THREE.Matrix4().makeBasis(right, ahead, normal);
  const size = REACH * radius;
  const material = new THREE.ShadowMaterial({ blending: THREE.AdditiveBlending });
  Object.assign(material, { premultipliedAlpha: true, depthTest: false, depthWrite: false });
  // Shadows of one colour each; three.js adds them up in the picture.
  material.onBeforeCompile = (shader) => {
    shader.fragmentShader = shader.fragmentShader.replace(
      "gl_FragColor = vec4( color, opacity * ( 1.0 - getShadowMask() ) );",
      "gl_FragColor = vec4( color * ( 1.0 - getShadowMask() ), 1.0 );",
    ).replace("#include <colorspace_fragment>", "").replace("#include <tonemapping_fragment>", "");
  };
  const plane = new THREE.Mesh(new THREE.PlaneGeometry(2 * size, 2 * size), material);
  plane.receiveShadow = true;
  plane.quaternion.setFromRotationMatrix(turn);
  plane.position.copy(foot);
  const eye = new THREE.OrthographicCamera(-size, size, size, -size, 0, 2);
  eye.quaternion.copy(plane.quaternion);
  eye.position.copy(foot).add(normal);
  const middle = new THREE.Vector3(...scene.middle);
  const lights = DEPTHS.map((texels) => {
    const light = new THREE.DirectionalLight();
    light.castShadow = true;
    light.shadow.mapSize.set(texels, texels);
    light.shadow.normalBias = radius / 300;
    light.target.position.copy(middle);
    return light;
  });
  const hidden = new THREE.MeshBasicMaterial({ colorWrite: false, depthWrite: false });
  hidden.shadowSide = THREE.DoubleSide;
  const caster = object.clone();
  caster.traverse((part) => { if (part.isMesh) part.material = hidden; });
  const stage = new THREE.Scene();
  stage.add(plane, caster, ...lights, ...lights.map((light) => light.target));
  let done = 0;
  const step = () => {
    const [x, y, z, ...color] = scene.shadow[done];
    const axis = new THREE.Vector3(x, y, z);
    const low = Math.max(axis.dot(normal), 0.05);
    const isSun = Math.max(...color) > LARGE;
    [lights[0].visible, lights[1].visible] = [isSun, !isSun];
    const light = lights[isSun ? 0 : 1];
    const { camera } = light.shadow;
    light.position.copy(middle).addScaledVector(axis, 2 * radius);
    [camera.left, camera.right, camera.top, camera.bottom] = [-radius, radius, radius, -radius];
    [camera.near, camera.far] = [0.5 * radius, 3 * radius + (2 * radius) / low];
    camera.updateProjectionMatrix();
    material.color.setRGB(...color);
    renderer.setRenderTarget(target);
    renderer.autoClear = false;
    if (done === 0) {
      renderer.setClearColor(0, 0);
      renderer.clear();
    }
    renderer.render(stage, eye);
    renderer.autoClear = true;
    renderer.setRenderTarget(null);
    done += 1;
  };
  const toPicture = new THREE.Matrix4().makeTranslation(0.5, 0.5, 0)
    .multiply(new THREE.Matrix4().makeScale(0.5 / size, 0.5 / size, 1))
    .multiply(turn.clone().setPosition(foot).invert());
  return { texture: target.texture, toPicture, size, turn, isDone: () => done >= scene.shadow.length, step };
}

async function start() {
  const core = await module("core", {});
  const three = await module("three", { '"./three.core.min.js"': core });
  const geometry = await module("geometry", { "'three'": three });
  const loader = await module("gltf", { "'three'": three, "'../utils/BufferGeometryUtils.js'": geometry });
  const [THREE, { GLTFLoader }] = await Promise.all([import(three), import(loader)]);

  const canvas = element("stage");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.type = THREE.PCFShadowMap;
  const { w, h, c2w } = scene.camera;
  const [a, b, c, d] = scene.ground;
  const normal = new THREE.Vector3(a, b, c);
  const middle = new THREE.Vector3(...scene.middle);
  const foot = middle.clone().addScaledVector(normal, -(middle.dot(normal) + d));

  const world = new THREE.Scene();
  const gltf = await new GLTFLoader().parseAsync(await unpack("object"), "");
  gltf.scene.traverse((part) => {
    part.castShadow = part.receiveShadow = Boolean(part.isMesh);
    part.frustumCulled = false;
    if (part.isMesh) part.material.shadowSide = THREE.DoubleSide;
  });
  gltf.scene.updateMatrixWorld(true);
  world.add(gltf.scene);
  const pmrem = new THREE.PMREMGenerator(renderer);
  const sky = skyMap(THREE, new Uint8Array(await unpack("sky")));
  world.environment = pmrem.fromEquirectangular(sky).texture;
  if (scene.sun) {
    const strongest = Math.max(...scene.sun.irradiance);
    const light = new THREE.DirectionalLight();
    light.color.setRGB(...scene.sun.irradiance.map((part) => part / strongest));
    light.intensity = strongest;
    light.position.copy(middle).addScaledVector(new THREE.Vector3(...scene.sun.axis), 2 * scene.radius);
    light.target.position.copy(middle);
    light.castShadow = true;
    light.shadow.mapSize.set(2048, 2048);
    const lens = light.shadow.camera;
    const { radius } = scene;
    [lens.left, lens.right, lens.top, lens.bottom] = [-radius, radius, radius, -radius];
    [lens.near, lens.far] = [0.5 * radius, 4 * radius];
    light.shadow.normalBias = radius / 300;
    world.add(light, light.target);
  }

  // The photo behind everything, its codes as they are.
  const picture = new THREE.Texture(element("photo"));
  picture.needsUpdate = true;
  picture.generateMipmaps = false;
  picture.minFilter = THREE.LinearFilter;
  const backdrop = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), new THREE.ShaderMaterial({
    uniforms: { picture: { value: picture } }, depthTest: false, depthWrite: false,
    vertexShader: "varying vec2 at; void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }",
    fragmentShader: "uniform sampler2D picture; varying vec2 at; void main() { gl_FragColor = texture2D(picture, at); }",
  }));
  backdrop.frustumCulled = false;
  backdrop.renderOrder = -2;
  world.add(backdrop);

  const shade = shadowPicture(THREE, renderer, gltf.scene, normal, foot);
  const ground = new THREE.Mesh(new THREE.PlaneGeometry(2 * shade.size, 2 * shade.size), new THREE.ShaderMaterial({
    uniforms: { hidden: { value: shade.texture }, toPicture: { value: shade.toPicture } },
    blending: THREE.CustomBlending, blendSrc: THREE.ZeroFactor, blendDst: THREE.SrcColorFactor,
    depthWrite: false, side: THREE.DoubleSide, transparent: true,
    vertexShader: "uniform mat4 toPicture; varying vec2 at; void main() { vec4 p = modelMatrix * vec4(position, 1.0); at = (toPicture * p).xy; gl_Position = projectionMatrix * viewMatrix * p; }",
    // warpir composites photo ** 2.2 times the share of light that is left.
    fragmentShader: "uniform sampler2D hidden; varying vec2 at; void main() { vec3 left = clamp(1.0 - texture2D(hidden, at).rgb, 0.0, 1.0); gl_FragColor = vec4(pow(left, vec3(1.0 / 2.2)), 1.0); }",
  }));
  ground.quaternion.setFromRotationMatrix(shade.turn);
  ground.position.copy(foot);
  ground.renderOrder = -1;
  world.add(ground);

  const camera = new THREE.Camera();
  camera.matrixAutoUpdate = false;
  const photoPose = new THREE.Matrix4().set(...c2w.flat());
  const eye = new THREE.Vector3().setFromMatrixPosition(photoPose);
  const home = eye.clone().sub(middle);
  const around = { turn: 0, tilt: 0, distance: 1 };
  const draw = () => {
    const isTurning = element("orbit").checked;
    backdrop.visible = !isTurning;
    gltf.scene.visible = element("object").checked;
    ground.visible = element("shadow").checked;
    renderer.setClearColor(0xbdbdbd, 1);
    camera.matrix.copy(photoPose);
    if (isTurning) {
      const offset = home.clone().multiplyScalar(around.distance).applyAxisAngle(normal, around.turn);
      const side = new THREE.Vector3().crossVectors(normal, offset).normalize();
      offset.applyAxisAngle(side, around.tilt);
      camera.matrix.lookAt(offset, new THREE.Vector3(), normal).setPosition(offset.add(middle));
    }
    camera.matrixWorld.copy(camera.matrix);
    camera.matrixWorldInverse.copy(camera.matrix).invert();
    const away = new THREE.Vector3().setFromMatrixPosition(camera.matrix).distanceTo(middle);
    const near = Math.max(away - 1.5 * scene.radius, 0.01 * away);
    // Turning, the object is in the middle: the principal point is, too.
    const seen = isTurning ? { ...scene.camera, cx: w / 2, cy: h / 2 } : scene.camera;
    camera.projectionMatrix.fromArray(projection(seen, near, away + 20 * shade.size));
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    renderer.toneMapping = scene.tone === "reinhard" ? THREE.ReinhardToneMapping : THREE.NoToneMapping;
    renderer.render(world, camera);
  };
  const fit = () => {
    const view = element("view");
    const width = Math.min(view.parentElement.clientWidth - 24, (window.innerHeight * 0.85 * w) / h);
    view.style.width = width + "px";
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setSize(width, (width * h) / w);
    draw();
  };
  window.addEventListener("resize", fit);
  for (const id of ["orbit", "object", "shadow"]) {
    element(id).addEventListener("change", () => {
      const isTurning = element("orbit").checked;
      canvas.classList.toggle("turning", isTurning);
      element("help").textContent = isTurning
        ? "Drag to turn, wheel or + and - to come nearer, arrow keys too." : "The camera is the photo's.";
      draw();
    });
  }
  const turnBy = (x, y) => {
    if (!element("orbit").checked) return;
    around.turn -= x;
    const up = Math.asin(home.clone().normalize().dot(normal));
    around.tilt = Math.min(Math.max(around.tilt - y, up - 1.5), up + 0.4);
    draw();
  };
  const zoomBy = (factor) => {
    around.distance = Math.min(Math.max(around.distance * factor, 0.2), 5);
    draw();
  };
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (canvas.hasPointerCapture(event.pointerId)) turnBy(event.movementX / 200, event.movementY / 200);
  });
  canvas.addEventListener("wheel", (event) => {
    if (!element("orbit").checked) return;
    event.preventDefault();
    zoomBy(2 ** (event.deltaY / 500));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    const factor = { "+": 0.9, "-": 1.1 }[event.key];
    if (!element("orbit").checked || (!step && !factor)) return;
    event.preventDefault();
    if (step) turnBy(...step);
    if (factor) zoomBy(factor);
  });
  fit();
  const more = () => {
    for (let k = 0; k < PER_FRAME && !shade.isDone(); k++) shade.step();
    draw();
    if (!shade.isDone()) return requestAnimationFrame(more);
    element("state").hidden = true;
    document.body.dataset.ready = "yes";
  };
  more();
}
start().catch((error) => {
  element("state").textContent = "This browser cannot draw it: " + error.message;
  throw error;
});
