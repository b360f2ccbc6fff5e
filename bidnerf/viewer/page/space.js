// The map in space: points, cameras, poses of the search, ellipsoid and trajectory.
import { colourOf, numbers } from "./data.js";

const FOV = 55;
const SPREAD = 2.2; // radius of a point of the surface over that of its surfel, which closes gaps
const SAMPLE = 2000,
  REACH = 3; // points that a view is fitted to, and how far from the middle, in extents, what else it shows may be
const SHARED = 0.7,
  LEAST_OBJECT = 0.05; // share of the images that show a point of an object, and of the points that are such
const SLOW = 45,
  REST = 180,
  LEAST_SHARE = 0.08; // ms of a frame, ms without motion, share of the points

const VERTEX = `
uniform float radius, height, least, sided;
attribute vec3 tint, facing;
attribute float extent;
varying vec3 vTint;
void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  gl_PointSize = clamp(extent * radius * height * projectionMatrix[1][1] / max(-seen.z, 1e-6), least, 40.0);
  vTint = tint;
  if (sided > 0.5 && dot(normalMatrix * facing, normalize(-seen.xyz)) < -0.1) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}`;
const FRAGMENT = `
varying vec3 vTint;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  gl_FragColor = vec4(vTint, 1.0);
}`;

function matrixOf(pose) {
  return new THREE.Matrix4().set(...pose.slice(0, 12), 0, 0, 0, 1);
}

// The edges of a camera's pyramid of the given depth, in its own axes (x right, y down, z forward).
function pyramid(shape, depth) {
  const s = shape ?? { left: -0.6, right: 0.6, top: -0.45, bottom: 0.45 };
  const corners = [
    [s.left, s.top],
    [s.right, s.top],
    [s.right, s.bottom],
    [s.left, s.bottom],
  ].map(([x, y]) => [x * depth, y * depth, depth]);
  const lines = [];
  corners.forEach((corner, i) => {
    lines.push([0, 0, 0], corner, corner, corners[(i + 1) % 4]);
  });
  const peak = [(corners[0][0] + corners[1][0]) / 2, corners[0][1] * 1.25, depth]; // marks the upper side of the image
  lines.push(corners[0], peak, peak, corners[1]);
  return { lines, corners };
}

export class Space {
  constructor(canvas, map) {
    this.canvas = canvas;
    this.map = map;
    this.share = 1;
    this.moved = () => {};
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.setClearColor(0, 0);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FOV, 1, map.extent / 2000, map.extent * 60);
    this.layers = {};
    this.size = 0.05 * map.extent; // depth of a pyramid that is drawn for a camera
    for (const name of [
      "surface",
      "landmarks",
      "splats",
      "cameras",
      "search",
      "answer",
      "runner",
      "matches",
      "track",
      "measure",
    ]) {
      this.layers[name] = new THREE.Group();
      this.scene.add(this.layers[name]);
    }
    this.tags = [];
    this.places = [];
    this.sample = [];
    this.addMap();
    this.resize();
    this.overview();
    new ResizeObserver(() => {
      this.resize();
      if (!this.touched) this.overview();
    }).observe(canvas.parentElement);
    const draw = (now) => {
      if (this.flight) this.fly(now);
      this.adapt(now);
      if (this.dirty) {
        this.dirty = false;
        this.renderer.render(this.scene, this.camera);
        this.placeLabels();
        this.drawn = (this.drawn ?? 0) + 1;
      }
      requestAnimationFrame(draw);
    };
    requestAnimationFrame(draw);
  }

  changed() {
    this.dirty = true;
  }

  // Draw fewer and larger points of the surface while the camera moves, as many as keep up with it, and all at rest.
  adapt(now) {
    const { surface } = this,
      took = now - (this.before ?? now),
      last = this.moving ?? -REST;
    const moving = last >= (this.before ?? now) || now - last < REST;
    this.before = now;
    if (!surface) return;
    if (moving && took > SLOW) this.share = Math.max(LEAST_SHARE, this.share * Math.max(0.4, SLOW / took));
    else if (moving && took < SLOW / 2) this.share = Math.min(1, this.share * 1.05);
    const share = moving ? this.share : 1;
    if (share === this.drawnShare) return;
    this.drawnShare = share;
    surface.geometry.setDrawRange(0, Math.ceil(share * surface.geometry.attributes.position.count));
    surface.material.uniforms.radius.value = (SPREAD * this.map.surface.radius) / Math.sqrt(share);
    this.changed();
  }

  resize() {
    const box = this.canvas.parentElement.getBoundingClientRect();
    if (!box.width || !box.height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(box.width, box.height, false);
    this.camera.aspect = box.width / box.height;
    this.camera.updateProjectionMatrix();
    const height = box.height * this.renderer.getPixelRatio();
    this.scene.traverse((each) => {
      if (each.material?.uniforms?.height) each.material.uniforms.height.value = height;
    });
    this.changed();
    this.moved();
  }

  // Controls keep the upward direction with which they are made.
  control(up, target) {
    this.controls?.dispose();
    this.camera.up.copy(up);
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    this.controls.zoomSpeed = 0.8;
    this.controls.target.copy(target);
    this.controls.update();
    this.controls.addEventListener("start", () => {
      this.touched = true;
    });
    this.controls.addEventListener("change", () => {
      this.moving = performance.now();
      this.changed();
      this.moved();
    });
    this.changed();
    this.moved();
  }

  // Look at what most images show, or, if there is nothing of the kind or the whole is wanted, at the map with its cameras.
  overview() {
    const up = new THREE.Vector3(...this.map.up).normalize();
    const object = this.whole ? null : this.object,
      centre = new THREE.Vector3(...this.map.centre);
    if (object) object.reduce((sum, point) => sum.add(point), centre.set(0, 0, 0)).divideScalar(object.length);
    const level = new THREE.Vector3(Math.abs(up.x) < 0.8 ? 1 : 0, Math.abs(up.x) < 0.8 ? 0 : 1, 0);
    level.addScaledVector(up, -level.dot(up)).normalize();
    const behind = new THREE.Vector3(),
      middle = new THREE.Vector3();
    for (const { pose } of this.map.cameras) {
      // look the way in which the cameras do
      behind.add(new THREE.Vector3(-pose[2], -pose[6], -pose[10]));
      middle.add(new THREE.Vector3(pose[3], pose[7], pose[11]));
    }
    behind.addScaledVector(up, -behind.dot(up));
    if (behind.length() > 0.25 * this.map.cameras.length) level.copy(behind.normalize());
    this.camera.fov = FOV;
    this.camera.updateProjectionMatrix();
    const { target, distance, back } = this.fitted(
      object,
      centre,
      level.multiplyScalar(1.25).addScaledVector(up, 0.8).normalize(),
      up,
    );
    this.camera.position.copy(target).addScaledVector(back, distance);
    this.control(up, target);
  }

  // From where, along a direction, an object, or the map but for a few points and its cameras, and the places to see fill the window.
  fitted(object, centre, back, up) {
    const right = up.clone().cross(back).normalize(),
      above = back.clone().cross(right);
    const seen = (points) =>
      points.map((point) => {
        const v = point.clone().sub(centre);
        return [v.dot(right), v.dot(above), v.dot(back)];
      });
    const cameras = this.map.cameras.map(({ pose }) => new THREE.Vector3(pose[3], pose[7], pose[11]));
    const near = this.places
      .map((place) => new THREE.Vector3(...place))
      .filter((place) => place.distanceTo(centre) < REACH * this.map.extent);
    const around = near.flatMap((place) =>
      [right, above].flatMap((axis) => [-1, 1].map((sign) => place.clone().addScaledVector(axis, sign * this.size))),
    );
    const groups = [
      [seen(object ?? this.sample), 0.01],
      [object ? [] : seen(cameras), 0.1],
      [seen(around), 0],
    ].filter(([points]) => points.length);
    const span = (values, beyond) => {
      const sorted = values.sort((a, b) => a - b),
        last = sorted.length - 1;
      return [sorted[Math.ceil(beyond * last)], sorted[Math.floor((1 - beyond) * last)]];
    };
    const middle = [0, 1].map((i) => {
      const ends = groups.map(([points, beyond]) =>
        span(
          points.map((point) => point[i]),
          beyond,
        ),
      );
      return groups.length
        ? (Math.min(...ends.map(([low]) => low)) + Math.max(...ends.map(([, high]) => high))) / 2
        : 0;
    });
    const tall = Math.tan((FOV * Math.PI) / 360),
      margin = object ? 0.85 : 1,
      slopes = [tall * this.camera.aspect * 0.92 * margin, tall * 0.82 * margin];
    const needed = ([x, y, z]) =>
      z + Math.max(Math.abs(x - middle[0]) / slopes[0], Math.abs(y - middle[1]) / slopes[1]);
    const distance = Math.max(
      0.02 * this.map.extent,
      ...groups.map(([points, beyond]) => span(points.map(needed), beyond)[1]),
    );
    return {
      target: centre.clone().addScaledVector(right, middle[0]).addScaledVector(above, middle[1]),
      distance,
      back,
    };
  }

  // Show these places too in the view of the whole map, which is taken unless another one was chosen.
  frame(places) {
    this.places = places;
    if (!this.touched) this.overview();
  }

  fit() {
    this.touched = false;
    this.whole = true;
    this.faint(false);
    const from = this.where();
    this.overview();
    this.travel(from);
  }

  where() {
    return { position: this.camera.position.clone(), target: this.controls.target.clone(), fov: this.camera.fov };
  }

  // Move smoothly from another place to the present one.
  travel(from) {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    const to = this.where(),
      began = performance.now();
    this.flight = { from, to, began };
    this.fly(began);
  }

  fly(now) {
    const { from, to, began } = this.flight,
      x = Math.max(0, Math.min(1, (now - began) / 450)),
      t = x * x * (3 - 2 * x);
    this.camera.position.lerpVectors(from.position, to.position, t);
    this.controls.target.lerpVectors(from.target, to.target, t);
    this.camera.fov = from.fov + t * (to.fov - from.fov);
    this.camera.updateProjectionMatrix();
    if (x >= 1) this.flight = null;
    this.controls.update();
    this.changed();
  }

  // Text at a place of a layer.
  label(layer, place, text, colour) {
    const tag = document.createElement("span");
    tag.textContent = text;
    tag.style.color = colour;
    document.getElementById("labels").append(tag);
    this.tags.push({ layer, tag, text, place: new THREE.Vector3(...place) });
    this.changed();
  }

  // Put labels above the cameras at their places; one that would lie on another moves up.
  placeLabels() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement,
      v = new THREE.Vector3(),
      taken = [];
    for (const { layer, tag, text, place } of this.tags) {
      v.copy(place).project(this.camera);
      const outside = v.z >= 1 || Math.abs(v.x) > 1 || Math.abs(v.y) > 1;
      tag.hidden = outside && layer !== "search";
      if (tag.hidden) continue;
      tag.textContent = outside ? `${text}: outside the view` : text;
      if (outside) v.multiplyScalar((v.z >= 1 ? -0.8 : 0.8) / Math.max(Math.abs(v.x), Math.abs(v.y)));
      const half = tag.offsetWidth / 2,
        x = Math.max(half + 4, Math.min(width - half - 4, ((v.x + 1) / 2) * width));
      const drawn =
        (0.7 * this.size * height) /
        (2 * Math.tan((this.camera.fov * Math.PI) / 360) * place.distanceTo(this.camera.position));
      let y = ((1 - v.y) / 2) * height - (outside ? 0 : 10 + Math.min(drawn, 0.2 * height));
      while (taken.some((other) => Math.abs(other.y - y) < 18 && Math.abs(other.x - x) < other.half + half)) y -= 18;
      taken.push({ x, y, half });
      tag.style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
    }
  }

  // Whether photos are drawn faintly, so that the map behind them can be compared.
  faint(on) {
    this.pictureOpacity = on ? 0.5 : 0.85;
    this.layers.answer.traverse((each) => {
      if (each.name === "picture") each.material.opacity = this.pictureOpacity;
    });
    this.changed();
  }

  // Look from a pose, with the field of view of its image.
  from(pose, shape) {
    this.touched = true;
    this.faint(true);
    const before = this.where(),
      m = pose;
    const up = new THREE.Vector3(-m[1], -m[5], -m[9]),
      forward = new THREE.Vector3(m[2], m[6], m[10]);
    const place = new THREE.Vector3(m[3], m[7], m[11]);
    const s = shape ?? { left: -0.6, right: 0.6, top: -0.45, bottom: 0.45 };
    const half = Math.max(Math.max(-s.top, s.bottom), Math.max(-s.left, s.right) / this.camera.aspect);
    this.camera.fov = (2 * Math.atan(1.08 * half) * 180) / Math.PI;
    this.camera.updateProjectionMatrix();
    this.camera.position.copy(place);
    this.control(up, place.clone().addScaledVector(forward, 0.3 * this.map.extent));
    this.travel(before);
  }

  // Look at a pose from behind and above, near enough to see what surrounds it.
  near(pose, distance = 6 * this.size) {
    this.touched = true;
    this.faint(false);
    const before = this.where(),
      up = new THREE.Vector3(...this.map.up).normalize();
    const place = new THREE.Vector3(pose[3], pose[7], pose[11]);
    const back = new THREE.Vector3(-pose[2], -pose[6], -pose[10]);
    this.camera.fov = FOV;
    this.camera.updateProjectionMatrix();
    this.camera.position
      .copy(place)
      .addScaledVector(back, distance)
      .addScaledVector(up, 0.55 * distance);
    this.control(up, place);
    this.travel(before);
  }

  show(name, visible) {
    this.layers[name].visible = visible;
    this.changed();
  }

  clear(name) {
    for (const { tag } of this.tags.filter(({ layer }) => layer === name)) tag.remove();
    this.tags = this.tags.filter(({ layer }) => layer !== name);
    for (const child of this.layers[name].children.slice()) {
      this.layers[name].remove(child);
      child.traverse((each) => {
        each.geometry?.dispose();
        each.material?.map?.dispose();
        each.material?.dispose();
      });
    }
    this.changed();
  }

  lines(layer, places, colour, { colours = null, opacity = 1, strip = false } = {}) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(places.flat()), 3));
    if (colours) geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(colours.flat()), 3));
    const material = new THREE.LineBasicMaterial({
      color: colours ? 0xffffff : new THREE.Color(colour),
      vertexColors: !!colours,
      opacity,
      transparent: opacity < 1,
    });
    const made = strip ? new THREE.Line(geometry, material) : new THREE.LineSegments(geometry, material);
    made.frustumCulled = false;
    this.layers[layer].add(made);
    this.changed();
    return made;
  }

  points(layer, geometry, radius, least) {
    if (!geometry.attributes.extent) {
      const ones = new Uint8Array(geometry.attributes.position.count).fill(1);
      geometry.setAttribute("extent", new THREE.BufferAttribute(ones, 1));
    }
    const height = this.canvas.height || 600;
    const material = new THREE.ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        radius: { value: radius },
        height: { value: height },
        least: { value: least },
        sided: { value: geometry.attributes.facing ? 1 : 0 },
      },
    });
    const made = new THREE.Points(geometry, material);
    made.frustumCulled = false;
    this.layers[layer].add(made);
    this.changed();
    return made;
  }

  addMap() {
    const { surface, landmarks } = this.map;
    for (const [name, part, least] of [
      ["surface", surface, 1.5],
      ["landmarks", landmarks, 2.5],
      ["splats", this.map.splats, 1],
    ]) {
      if (!part) continue;
      const geometry = new THREE.BufferGeometry(),
        places = numbers(part.points.places),
        count = places.length / 3;
      const positions = new Float32Array(places.length),
        { lower, size } = part.points;
      for (let i = 0; i < places.length; i++) positions[i] = lower[i % 3] + (places[i] / 65535) * size;
      geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
      if (!this.sample.length)
        for (let i = 0; i < Math.min(count, SAMPLE); i++)
          this.sample.push(new THREE.Vector3().fromArray(positions, 3 * i));
      let tints;
      if (part.colours) tints = numbers(part.colours);
      else {
        tints = new Uint8Array(3 * count);
        for (let i = 0; i < count; i++) tints.set([222, 138, 26], 3 * i);
      }
      geometry.setAttribute("tint", new THREE.BufferAttribute(tints, 3, true));
      if (part.sizes) geometry.setAttribute("extent", new THREE.BufferAttribute(numbers(part.sizes), 1));
      if (part.normals) geometry.setAttribute("facing", new THREE.BufferAttribute(numbers(part.normals), 3, true));
      const made = this.points(name, geometry, SPREAD * part.radius, least);
      if (name === "surface") this.surface = made;
      this.cloud ??= geometry;
    }
    this.size = Math.min(this.size, 0.25 * this.survey());
    const places = [];
    for (const { pose, shape } of this.map.cameras)
      places.push(...this.moved3(pyramid(shape, 0.35 * this.size).lines, pose));
    const drawn = places.length ? this.lines("cameras", places, colourOf("--soft"), { opacity: 0.8 }) : null;
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      drawn?.material.color.set(colourOf("--soft"));
      this.changed();
    });
  }

  // Find the points that most images show, an object if there is one; return how deep points lie in images, the median.
  survey() {
    const { cameras } = this.map,
      v = new THREE.Vector3(),
      depths = [],
      shown = this.sample.map(() => 0);
    let images = 0;
    for (let i = 0; i < cameras.length; i += Math.ceil(cameras.length / 40), images++) {
      const { pose, shape: s } = cameras[i],
        toCamera = matrixOf(pose).invert();
      this.sample.forEach((point, j) => {
        const { x, y, z } = v.copy(point).applyMatrix4(toCamera);
        if (z > 0 && x > s.left * z && x < s.right * z && y > s.top * z && y < s.bottom * z) {
          depths.push(z);
          shown[j]++;
        }
      });
    }
    const object = this.sample.filter((_, j) => images > 2 && shown[j] >= SHARED * images);
    this.object = object.length > LEAST_OBJECT * this.sample.length ? object : null;
    return depths.length ? depths.sort((a, b) => a - b)[depths.length >> 1] : Infinity;
  }

  moved3(lines, pose) {
    const m = matrixOf(pose),
      v = new THREE.Vector3();
    return lines.map((place) =>
      v
        .set(...place)
        .applyMatrix4(m)
        .toArray(),
    );
  }

  // A camera's pyramid, with its photo on the far side.
  frustum(layer, pose, shape, colour, { picture = null, depth = this.size, opacity = 1 } = {}) {
    const { lines, corners } = pyramid(shape, depth);
    this.lines(layer, this.moved3(lines, pose), colour, { opacity });
    if (!picture) return;
    const geometry = new THREE.BufferGeometry(),
      quad = this.moved3(corners, pose);
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(quad.flat()), 3));
    geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array([0, 1, 1, 1, 1, 0, 0, 0]), 2));
    geometry.setIndex([0, 2, 1, 0, 3, 2]);
    const texture = new THREE.Texture(),
      image = new Image();
    texture.colorSpace = THREE.SRGBColorSpace;
    image.onload = () => {
      texture.image = image;
      texture.needsUpdate = true;
      this.changed();
    };
    image.src = picture;
    const material = new THREE.MeshBasicMaterial({
      map: texture,
      side: THREE.DoubleSide,
      transparent: true,
      opacity: this.pictureOpacity ?? 0.85,
    });
    const made = new THREE.Mesh(geometry, material);
    made.name = "picture";
    this.layers[layer].add(made);
  }

  axes(layer, pose, length) {
    const ends = this.moved3(
      [
        [0, 0, 0],
        [length, 0, 0],
        [0, 0, 0],
        [0, length, 0],
        [0, 0, 0],
        [0, 0, length],
      ],
      pose,
    );
    const red = [0.85, 0.2, 0.2],
      green = [0.2, 0.65, 0.25],
      blue = [0.25, 0.45, 0.95];
    this.lines(layer, ends, null, { colours: [red, red, green, green, blue, blue] });
  }

  ellipsoid(layer, pose, axes, factor, colour) {
    const mesh = new THREE.Mesh(
      new THREE.SphereGeometry(1, 32, 20),
      new THREE.MeshBasicMaterial({
        color: new THREE.Color(colour),
        transparent: true,
        opacity: 0.35,
        depthWrite: false,
      }),
    );
    const [a, b, c] = [0, 3, 6].map((i) => new THREE.Vector3(...axes.slice(i, i + 3)).multiplyScalar(factor));
    for (const axis of [a, b, c]) if (axis.length() < 1e-9) axis.setLength(1e-9);
    mesh.matrixAutoUpdate = false;
    mesh.matrix.makeBasis(a, b, c).setPosition(pose[3], pose[7], pose[11]);
    mesh.name = "ellipsoid";
    this.layers[layer].add(mesh);
    const place = [pose[3], pose[7], pose[11]],
      ends = [];
    for (const axis of [a, b, c])
      for (const sign of [-1, 1]) ends.push(place.map((x, i) => x + sign * axis.getComponent(i)));
    this.lines(layer, ends, colour);
    return mesh;
  }

  // The poses of a step of the search, coloured by score, the best last so that they are in front.
  hypotheses(step, shape) {
    this.clear("search");
    const rows = numbers(step.poses),
      count = rows.length / 12,
      retained = [],
      others = [],
      tints = [],
      grey = [];
    const best = new THREE.Color(colourOf("--best")),
      worst = new THREE.Color(colourOf("--worst"));
    const known = step.scores.filter((s) => s !== null),
      low = Math.min(...known),
      high = Math.max(...known, low + 1e-9);
    for (let i = count - 1; i >= 0; i--) {
      const pose = [...rows.subarray(12 * i, 12 * i + 12), 0, 0, 0, 1];
      const places = this.moved3(pyramid(shape, this.size * (i === 0 ? 0.8 : 0.4)).lines, pose);
      const score = step.scores[i] ?? high,
        tint = best
          .clone()
          .lerp(worst, (score - low) / (high - low))
          .toArray();
      if (i < step.retained) {
        retained.push(...places);
        tints.push(...places.map(() => tint));
      } else {
        others.push(...places);
        grey.push(...places.map(() => tint));
      }
    }
    if (others.length) this.lines("search", others, null, { colours: grey, opacity: 0.5 });
    if (retained.length) this.lines("search", retained, null, { colours: tints });
    this.label(
      "search",
      [rows[3], rows[7], rows[11]],
      count > 1 ? "best of this step" : "this step",
      colourOf("--best"),
    );
  }

  // The number of the map's camera that is drawn nearest to a place on the canvas, or -1 if none is near.
  cameraAt(x, y, reach = 14) {
    const box = this.canvas.getBoundingClientRect(),
      v = new THREE.Vector3();
    let best = -1,
      least = reach;
    if (!this.layers.cameras.visible) return best;
    this.map.cameras.forEach(({ pose }, i) => {
      v.set(pose[3], pose[7], pose[11]).project(this.camera);
      const off = Math.hypot(((v.x + 1) / 2) * box.width - x, ((1 - v.y) / 2) * box.height - y);
      if (v.z < 1 && off < least) {
        least = off;
        best = i;
      }
    });
    return best;
  }

  // The point of the map that is drawn at a place on the canvas: of those within a few pixels, the nearest that faces the eye.
  pointAt(x, y, reach = 6) {
    const box = this.canvas.getBoundingClientRect(),
      eye = this.camera.position,
      v = new THREE.Vector3(),
      n = new THREE.Vector3();
    const { position, facing } = this.cloud?.attributes ?? {};
    let best = null,
      least = Infinity;
    for (let i = 0; i < (position?.count ?? 0); i++) {
      const away = v.fromBufferAttribute(position, i).distanceTo(eye);
      if (away > least || (facing && n.fromBufferAttribute(facing, i).dot(v.clone().sub(eye)) > 0)) continue;
      v.project(this.camera);
      if (v.z < 1 && Math.hypot(((v.x + 1) / 2) * box.width - x, ((1 - v.y) / 2) * box.height - y) < reach) {
        least = away;
        best = i;
      }
    }
    return best === null ? null : v.fromBufferAttribute(position, best).toArray();
  }

  // Coloured dots.
  dots(layer, places, colours, radius) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(places.flat()), 3));
    geometry.setAttribute("tint", new THREE.BufferAttribute(new Float32Array(colours.flat()), 3));
    this.points(layer, geometry, radius, 4);
  }

  pose() {
    this.camera.updateMatrixWorld();
    return this.camera.matrixWorld.clone().transpose().toArray(); // by rows; camera axes x right, y up, z backward
  }
}
