// The motion of every engine side by side, in perspective, at one time; and the differences, magnified.
import { superscript, h, ink, number } from "./text.js";

/**
 * @typedef {import("./report_data").MotionData} MotionData @typedef {import("./report_data").Vec} Vec
 * @typedef {MotionData["runs"][number]} Run
 * @typedef {[number, number, number, number]} Quat
 * @typedef {{ r: Vec, q: Quat }} Pose
 * @typedef {{ canvas: HTMLCanvasElement, note: HTMLElement, run: Run, colour: string }} View
 */

/** @param {Quat} q @param {Vec} v @returns {Vec} */
function turn([w, x, y, z], v) {
  const tx = 2 * (y * v[2] - z * v[1]);
  const ty = 2 * (z * v[0] - x * v[2]);
  const tz = 2 * (x * v[1] - y * v[0]);
  return [v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx];
}

/** @param {Quat} a @param {Quat} b @returns {Quat} */
function multiply([aw, ax, ay, az], [bw, bx, by, bz]) {
  return [aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw];
}

/** exp of a rotation vector @param {number} x @param {number} y @param {number} z @returns {Quat} */
function exponential(x, y, z) {
  const angle = Math.hypot(x, y, z);
  const s = angle < 1e-9 ? 0.5 : Math.sin(angle / 2) / angle;
  return [Math.cos(angle / 2), s * x, s * y, s * z];
}

/** @param {Vec} a @param {Vec} b @param {number} [k] @returns {Vec} a + k b */
const add = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];

/** The frame before a time and the fraction to the next. @param {Float32Array} times @param {number} t @returns {[number, number]} */
function frameAt(times, t) {
  let low = 0;
  let high = times.length - 1;
  if (high < 1 || t <= times[0]) return [0, 0];
  if (t >= times[high]) return [high - 1, 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle;
    else high = middle;
  }
  return [low, (t - times[low]) / (times[high] - times[low])];
}

/** Poses of the base run at a time. @param {MotionData} m @param {number} t @returns {Pose[]} */
function basePoses(m, t) {
  const [frame, part] = frameAt(m.t, t);
  const next = Math.min(frame + 1, m.t.length - 1);
  const poses = [];
  for (let body = 0; body < m.bodies; body++) {
    const [a, b] = [frame * m.bodies + body, next * m.bodies + body];
    const along = m.p[4 * a] * m.p[4 * b] + m.p[4 * a + 1] * m.p[4 * b + 1] + m.p[4 * a + 2] * m.p[4 * b + 2] + m.p[4 * a + 3] * m.p[4 * b + 3];
    const sign = along < 0 ? -1 : 1; // q and −q are the same attitude: interpolate along the shorter arc
    const q = [0, 1, 2, 3].map((i) => (1 - part) * m.p[4 * a + i] + part * sign * m.p[4 * b + i]);
    const size = Math.hypot(...q) || 1;
    const r = [0, 1, 2].map((i) => (((1 - part) * m.r[3 * a + i] + part * m.r[3 * b + i]) * m.span) / 32767);
    poses.push({ r: /** @type {Vec} */ (r), q: /** @type {Quat} */ (q.map((v) => v / size)) });
  }
  return poses;
}

/**
 * How far a run is from the base at a time: (n, 6) of m and rad; null where it is not finite.
 * @param {MotionData} m @param {Run} run @param {number} t
 */
function differences(m, run, t) {
  const [frame, part] = frameAt(m.t, t);
  const next = Math.min(frame + 1, m.t.length - 1);
  const [a, b] = [run.scale[frame], part > 0 ? run.scale[next] : 0];
  if (Number.isNaN(a) || Number.isNaN(b)) return null;
  const width = 6 * m.bodies;
  return Float64Array.from({ length: width }, (_, i) => ((1 - part) * a * run.d[frame * width + i] + part * b * run.d[next * width + i]) / 127);
}

/** @param {Pose[]} poses @param {Float64Array} difference @param {number} magnify @returns {Pose[]} */
function displaced(poses, difference, magnify) {
  return poses.map(({ r, q }, k) => {
    const d = difference.subarray(6 * k, 6 * k + 6);
    return { r: add(r, [d[0], d[1], d[2]], magnify), q: multiply(exponential(magnify * d[3], magnify * d[4], magnify * d[5]), q) };
  });
}

/**
 * The pictures of all engines with the controls of their time.
 * @param {import("./report_data").ScenarioChunk} data
 * @param {{ engine: string, engines: string[], titleOf: (engine: string) => string, judged: boolean, end: number, start: number, magnify: number | null, crossing: { t: number, name: string } | null,
 *   onTime: (t: number) => void, onRest: (state: Record<string, any>) => void }} o
 */
export function motion(data, o) {
  const m = data.motion;
  let now = Math.min(Math.max(o.start, 0), o.end);
  let magnify = o.magnify !== null && Number.isFinite(o.magnify) ? o.magnify : null;
  let playing = 0;
  const camera = { yaw: -1.05, pitch: 0.28, zoom: 1 };
  const scene = m ? bounds(m) : null;
  /** @type {View[]} */
  const views = [];

  const slider = h("input", { type: "range", min: 0, max: o.end, step: "any", "aria-label": "Time", input: () => setTime(Number(slider.value)), change: () => rest() });
  const clock = h("output", { class: "now" });
  const play = h("button", { type: "button", click: () => (playing ? pause() : start()) }, "▶ Play");
  const speed = h("select", { "aria-label": "Speed" }, [0.1, 0.25, 1, 4].map((v) => h("option", { value: v, selected: v === 1 }, `${v}×`)));
  const { crossing } = o;
  const jump = crossing ? h("button", { type: "button", click: () => { pause(); setTime(crossing.t); rest(); } }, `First above tolerance: ${number(crossing.t, 4)} s (${crossing.name})`)
    : o.judged ? h("span", { class: "scale" }, "These positions stay within their tolerance") : null;
  const power = h("input", { type: "range", class: "mag", min: 0, max: 16, step: 1, "aria-label": "Magnification, power of ten", input: () => { magnify = Number(power.value); drawAll(); }, change: () => rest() });
  const magnified = h("input", { type: "checkbox", change: () => { magnify = magnified.checked ? suited() : null; drawAll(); rest(); } });
  const scale = h("span", { class: "scale" });
  const transport = h("div", { class: "transport", role: "group", "aria-label": "Time and difference" }, play, slider, clock, speed, jump,
    m ? h("label", {}, magnified, "Magnify differences") : null, m ? power : null, m ? scale : null);
  const stage = h("div", { class: "stage" });
  const root = h("div", { class: "motion" }, m ? stage : null);

  if (m) {
    (m.base[0] ? o.engines : [""]).forEach((engine, k) => { // "": a still of the initial state
      const run = m.runs.find((one) => one.engine === engine);
      if (!run) return;
      const note = h("span", { class: "off" });
      const canvas = h("canvas", { tabindex: 0, role: "img" });
      /** @type {View} */
      const view = { canvas, note, run, colour: `--c${k % 8}` };
      stage.append(h("figure", { class: engine === o.engine ? "mine" : "" }, h("figcaption", {}, h("b", { title: name(engine) }, name(engine)), h("span", {}, run.integrator)), canvas, h("figcaption", {}, note)));
      label(view);
      orbit(canvas);
      views.push(view);
    });
    if (m.shape.length > m.bodies) root.append(h("p", { class: "note" }, "Squares are the joints that close loops; short lines are the axes of joints."));
  }

  /** @param {string} engine */
  function name(engine) {
    return engine ? o.titleOf(engine) : "Initial state";
  }

  /** @param {View} view */
  function label(view) {
    view.canvas.setAttribute("aria-label", `Motion of ${name(view.run.engine)}, ${view.run.integrator}; arrow keys turn the view`);
  }

  /** @param {Run} run */
  function final(run) {
    const last = run.scale[run.scale.length - 1];
    return Number.isNaN(last) ? Infinity : last;
  }

  /** A power of ten that makes the present engine's median difference a good part of the picture. */
  function suited() {
    const run = views.find((view) => view.run.engine === o.engine && final(view.run) !== 0)?.run ?? views.find((view) => final(view.run) > 0)?.run;
    const sizes = run ? [...run.scale].filter((v) => v > 0).sort((a, b) => a - b) : [];
    if (!sizes.length || !scene) return 0;
    return Math.min(16, Math.max(0, Math.floor(Math.log10((0.5 * scene.radius) / sizes[sizes.length >> 1]))));
  }

  /** @param {HTMLCanvasElement} canvas */
  function orbit(canvas) {
    let held = false;
    canvas.addEventListener("pointerdown", (event) => { held = true; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointerup", () => (held = false));
    canvas.addEventListener("pointercancel", () => (held = false));
    canvas.addEventListener("pointermove", (event) => held && look(-event.movementX / 120, event.movementY / 120));
    canvas.addEventListener("dblclick", () => { Object.assign(camera, { yaw: -1.05, pitch: 0.28, zoom: 1 }); drawAll(); });
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return; // a plain wheel scrolls the page
      event.preventDefault();
      camera.zoom = Math.min(6, Math.max(0.4, camera.zoom * Math.exp(-event.deltaY / 300)));
      drawAll();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = /** @type {Record<string, [number, number]>} */ ({ ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] })[event.key];
      if (!step) return;
      event.preventDefault();
      look(...step);
    });
  }

  /** @param {number} yaw @param {number} pitch */
  function look(yaw, pitch) {
    camera.yaw += yaw;
    camera.pitch = Math.min(1.5, Math.max(-1.5, camera.pitch + pitch));
    drawAll();
  }

  /** @param {View} view */
  function draw(view) {
    if (!m || !scene) return;
    const difference = differences(m, view.run, now);
    const poses = basePoses(m, now);
    const context = prepare(view.canvas);
    if (!context) return;
    const see = projector(view.canvas, camera, scene);
    floor(context, see, scene);
    trail(context, see, m, now);
    const isBase = view.run.engine === m.base[0] && view.run.integrator === m.base[1];
    if (!difference) {
      view.note.textContent = "not finite at this time";
      return;
    }
    let apart = 0;
    for (let k = 0; k < m.bodies; k++) apart = Math.max(apart, Math.hypot(difference[6 * k], difference[6 * k + 1], difference[6 * k + 2]));
    view.note.textContent = !m.base[0] ? "no motion was stored" : isBase ? "the base of the differences" : `${number(apart)} m from ${o.titleOf(m.base[0])}`;
    if (magnify !== null && !isBase) tree(context, see, m, poses, ink("--soft"), true, scene);
    tree(context, see, m, displaced(poses, difference, magnify === null ? 1 : 10 ** magnify), ink(view.colour), false, scene);
  }

  function drawAll() {
    views.forEach(draw);
    magnified.checked = magnify !== null;
    power.disabled = magnify === null;
    power.value = String(magnify ?? 0);
    power.setAttribute("aria-valuetext", `10 to the ${magnify ?? 0}`);
    scale.textContent = magnify === null ? "true positions" : `×10${superscript(magnify)}: 1 cm drawn is ${number(10 ** (-2 - magnify))} m`;
  }

  /** @param {number} t */
  function setTime(t) {
    now = Math.min(Math.max(t, 0), o.end);
    slider.value = String(now);
    slider.setAttribute("aria-valuetext", `${now.toFixed(3)} s`);
    clock.textContent = `${now.toFixed(3)} s`;
    drawAll();
    o.onTime(now);
  }

  function rest() {
    o.onRest({ t: now ? Number(now.toFixed(4)) : "", mag: magnify ?? "" });
  }

  function start() {
    if (now >= o.end) now = 0;
    let last = performance.now();
    play.textContent = "❚❚ Pause";
    const tick = (/** @type {number} */ at) => {
      setTime(now + (Math.max(at - last, 0) / 1000) * Number(speed.value));
      last = at;
      if (now >= o.end) pause();
      else playing = requestAnimationFrame(tick);
    };
    playing = requestAnimationFrame(tick);
  }

  function pause() {
    if (playing) rest();
    cancelAnimationFrame(playing);
    playing = 0;
    play.textContent = "▶ Play";
  }

  const watch = new ResizeObserver(() => drawAll());
  watch.observe(stage);
  setTime(now);
  return {
    root,
    transport,
    setTime: (/** @type {number} */ t) => { setTime(t); rest(); },
    time: () => now,
    destroy() {
      cancelAnimationFrame(playing);
      watch.disconnect();
    },
  };
}

/** Middle and radius of the space that the base run moves in; free bodies beside a mechanism may leave it. @param {MotionData} m */
function bounds(m) {
  /** @type {Vec} */
  const low = [0, 0, 0];
  /** @type {Vec} */
  const high = [0, 0, 0];
  /** @type {(k: number) => boolean} whether the branch of a body is free */
  const isFree = (k) => (m.shape[k].far < 0 ? m.shape[k].is_free : isFree(m.shape[k].far));
  const held = m.shape.slice(0, m.bodies).map((_, k) => !isFree(k));
  for (let i = 0; i < m.r.length; i++) {
    if (held.includes(true) && !held[Math.floor(i / 3) % m.bodies]) continue;
    const v = (m.r[i] * m.span) / 32767;
    low[i % 3] = Math.min(low[i % 3], v);
    high[i % 3] = Math.max(high[i % 3], v);
  }
  const size = Math.max(...m.shape.slice(0, 3).map((s) => Math.max(...s.half) * 1.2));
  const middle = /** @type {Vec} */ (low.map((v, i) => (v + high[i]) / 2));
  const radius = Math.max(Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]) / 2 + size, 1e-6);
  return { middle, radius, ground: low[2] - size - 0.06 * radius };
}

/** @typedef {ReturnType<typeof bounds>} Scene @typedef {(v: Vec) => [number, number, number]} See */

/** @param {HTMLCanvasElement} canvas */
function prepare(canvas) {
  const context = canvas.getContext("2d");
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!context || !width) return null;
  const fine = devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * fine) || canvas.height !== Math.round(height * fine)) {
    canvas.width = Math.round(width * fine);
    canvas.height = Math.round(height * fine);
  }
  context.setTransform(fine, 0, 0, fine, 0, 0);
  context.clearRect(0, 0, width, height);
  context.lineCap = "round";
  context.lineJoin = "round";
  return context;
}

/** World to canvas, in perspective: x, y in pixels, and the depth. @param {HTMLCanvasElement} canvas @param {{ yaw: number, pitch: number, zoom: number }} camera @param {Scene} scene @returns {See} */
function projector(canvas, camera, scene) {
  const [w, hgt] = [canvas.clientWidth, canvas.clientHeight];
  const away = 3.4 * scene.radius;
  const focal = 0.47 * Math.min(w * 1.05, hgt) * camera.zoom * (away / scene.radius) * 0.96;
  const [cy, sy, cp, sp] = [Math.cos(camera.yaw), Math.sin(camera.yaw), Math.cos(camera.pitch), Math.sin(camera.pitch)];
  return (v) => {
    const [x, y, z] = add(v, scene.middle, -1);
    const right = -sy * x + cy * y;
    const ahead = cp * (cy * x + sy * y) + sp * z;
    const up = -sp * (cy * x + sy * y) + cp * z;
    const depth = Math.max(away - ahead, 0.02 * away);
    return [w / 2 + (focal * right) / depth, hgt / 2 - (focal * up) / depth, depth];
  };
}

/** @param {CanvasRenderingContext2D} context @param {[number, number, number][]} points */
function polyline(context, points) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

/** @param {CanvasRenderingContext2D} context @param {See} see @param {Scene} scene */
function floor(context, see, scene) {
  context.strokeStyle = ink("--grid");
  context.lineWidth = 1;
  const [cx, cy] = scene.middle;
  for (let i = -4; i <= 4; i++) {
    const k = (i / 4) * scene.radius;
    polyline(context, [see([cx + k, cy - scene.radius, scene.ground]), see([cx + k, cy + scene.radius, scene.ground])]);
    polyline(context, [see([cx - scene.radius, cy + k, scene.ground]), see([cx + scene.radius, cy + k, scene.ground])]);
  }
}

/** Where the last body was in the last quarter of the run. @param {CanvasRenderingContext2D} context @param {See} see @param {MotionData} m @param {number} now */
function trail(context, see, m, now) {
  const [frame] = frameAt(m.t, now);
  const first = Math.max(0, frame - Math.round(m.t.length / 4));
  const points = [];
  for (let k = first; k <= frame; k++) {
    const at = 3 * (k * m.bodies + m.bodies - 1);
    points.push(see(/** @type {Vec} */ ([0, 1, 2].map((i) => (m.r[at + i] * m.span) / 32767))));
  }
  context.strokeStyle = ink("--line");
  context.lineWidth = 1.5;
  polyline(context, points);
}

const FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];

/**
 * Joints with their axes, rods, arms and bodies (boxes with the bodies' own principal moments), far ones first.
 * @param {CanvasRenderingContext2D} context @param {See} see @param {MotionData} m @param {Pose[]} poses @param {string} colour @param {boolean} ghost @param {Scene} scene
 */
function tree(context, see, m, poses, colour, ghost, scene) {
  const paper = ink("--card");
  /** @type {{ depth: number, paint: () => void }[]} */
  const parts = [];
  const dense = m.bodies > 12;
  m.shape.forEach((shape, k) => {
    const { r, q } = poses[shape.body];
    const closes = k >= m.bodies;
    const parent = shape.far < 0 ? null : poses[shape.far];
    const hang = parent ? add(parent.r, turn(parent.q, shape.hang)) : shape.hang;
    const near = shape.is_free ? r : add(r, turn(q, shape.near));
    const [a, b, c] = [see(hang), see(near), see(r)];
    const [free, apart] = [shape.is_free, shape.is_apart];
    const lines = [...shape.far_axes.map((axis) => [hang, parent ? turn(parent.q, axis) : axis]), ...shape.near_axes.map((axis) => [near, turn(q, axis)])]
      .map(([at, axis]) => [add(at, axis, -0.08 * scene.radius), add(at, axis, 0.08 * scene.radius)].map(see));
    parts.push({ depth: Math.max(a[2], b[2]), paint: () => {
      context.strokeStyle = colour;
      context.globalAlpha = ghost ? 0.55 : 1;
      context.setLineDash(ghost ? [3, 3] : []);
      if (apart) {
        context.lineWidth = ghost ? 1 : 2.2;
        polyline(context, [a, b]);
      }
      context.lineWidth = ghost ? 1 : dense ? 2 : 1.2;
      polyline(context, [b, c]);
      if (parent && !free) polyline(context, [see(parent.r), a]);
      context.setLineDash([]);
      if (!ghost && !dense && !free) {
        context.strokeStyle = ink("--ink");
        for (const line of lines) polyline(context, line);
        context.strokeStyle = colour;
        context.fillStyle = paper;
        for (const [x, y] of apart ? [a, b] : [b]) {
          context.beginPath();
          context.arc(x, y, 2.6, 0, 7);
          context.fill();
          context.stroke();
        }
      }
      context.globalAlpha = 1;
    } });
    if (!dense && !closes) {
      const corners = Array.from({ length: 8 }, (_, i) => shape.axes.reduce((v, axis, j) => add(v, turn(q, axis), shape.half[j] * ((i >> (2 - j)) & 1 ? 1 : -1)), r));
      const seen = corners.map(see);
      for (const face of FACES) {
        const depth = face.reduce((sum, i) => sum + seen[i][2], 0) / 4;
        const middle = face.reduce((v, i) => add(v, corners[i], 0.25), /** @type {Vec} */ ([0, 0, 0]));
        const outward = add(middle, r, -1);
        const light = 0.5 + (0.5 * (outward[2] * 0.8 + outward[0] * 0.4 + outward[1] * 0.2)) / (Math.hypot(...outward) || 1);
        parts.push({ depth, paint: () => {
          context.beginPath();
          face.forEach((i, j) => (j ? context.lineTo(seen[i][0], seen[i][1]) : context.moveTo(seen[i][0], seen[i][1])));
          context.closePath();
          context.strokeStyle = colour;
          context.lineWidth = 0.8;
          if (ghost) context.setLineDash([2, 2]);
          else {
            context.fillStyle = paper;
            context.globalAlpha = 0.85;
            context.fill();
            context.fillStyle = colour;
            context.globalAlpha = 0.16 + 0.4 * light;
            context.fill();
          }
          context.globalAlpha = ghost ? 0.5 : 0.9;
          context.stroke();
          context.setLineDash([]);
          context.globalAlpha = 1;
        } });
      }
    }
  });
  parts.sort((a, b) => b.depth - a.depth).forEach((part) => part.paint());
  if (ghost) return;
  context.fillStyle = ink("--ink");
  for (const shape of m.shape.filter((one) => one.far < 0 && !one.is_free)) {
    const [x, y] = see(shape.hang);
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x - 6, y - 9);
    context.lineTo(x + 6, y - 9);
    context.fill();
  }
  context.strokeStyle = ink("--ink");
  context.fillStyle = paper;
  context.lineWidth = 2;
  for (const shape of m.shape.slice(m.bodies)) { // joints that close loops, in front of all bodies
    const [x, y] = see(add(poses[shape.body].r, turn(poses[shape.body].q, shape.near)));
    context.fillRect(x - 4, y - 4, 8, 8);
    context.strokeRect(x - 4, y - 4, 8, 8);
  }
  context.strokeStyle = ink("--soft");
  context.globalAlpha = 0.25;
  context.lineWidth = 2;
  poses.forEach(({ r }, k) => { // shadow
    const { is_free, far, hang } = m.shape[k];
    const from = is_free ? r : far < 0 ? hang : poses[far].r;
    polyline(context, [from, r].map((v) => see([v[0], v[1], scene.ground])));
  });
  context.globalAlpha = 1;
}
