// The scene of the 3D panel: vehicle, arm, pipe, contact force, the last minute's trail. Frame W: x forward, y left,
// z up, m. All of it is taken from the log: shapes and the pipe from /params, the rest from /tick.
// pipewright.json holds this text as the user script "scene"; a test holds them equal.
import { Input } from "./types";
import { ArrowPrimitive, Color, CylinderPrimitive, LinePrimitive, Point3, SceneUpdate, TextPrimitive } from "@foxglove/schemas";

type Vector = [number, number, number];
type Numbers = ArrayLike<number>;

export const inputs = ["/params", "/tick"];
export const output = "/scene";

const PERIOD = 0.04; // s between two pictures
const TRAIL_PERIOD = 0.1; // s between two points of the trail
const TRAIL = 600; // points
const METRES_PER_NEWTON = 0.1; // length of the arrow of the force

const STRIP = 0; // LineType.LINE_STRIP: of another module, a script gets types only

const GREY: Color = { r: 0.55, g: 0.6, b: 0.65, a: 1 };
const PIPE: Color = { r: 0.75, g: 0.55, b: 0.3, a: 0.6 };
const CRACK: Color = { r: 0.8, g: 0.1, b: 0.1, a: 1 };
const ARM: Color = { r: 0.95, g: 0.6, b: 0.1, a: 1 };
const NEEDLE: Color = { r: 0.3, g: 0.75, b: 0.95, a: 1 };
const ROTOR: Color = { r: 0.3, g: 0.55, b: 0.9, a: 0.25 };
const NOSE: Color = { r: 0.3, g: 0.9, b: 0.7, a: 0.25 }; // the two rotors ahead
const FORCE: Color = { r: 0.95, g: 0.1, b: 0.5, a: 1 };
const TRACK: Color = { r: 0.2, g: 0.8, b: 0.4, a: 1 };
const SLEEVE: Color = { r: 0.9, g: 0.9, b: 0.3, a: 0.9 };
const TEXT: Color = { r: 0.6, g: 0.65, b: 0.7, a: 1 };

const UNCHANGED: SceneUpdate = { deletions: [], entities: [] }; // a script that returns nothing is warned of

let set: Input<"/params">["message"] | undefined;
let drawn = -Infinity;
let trail: Point3[] = [];
let trailed = -Infinity;

const at = (v: Numbers, i: number): number => v[i] ?? 0;
const vector = (v: Numbers): Vector => [at(v, 0), at(v, 1), at(v, 2)];
const plus = (a: Vector, b: Vector, scale = 1): Vector => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
const point = (v: Vector): Point3 => ({ x: v[0], y: v[1], z: v[2] });
const norm = (v: Vector): number => Math.hypot(v[0], v[1], v[2]);

/** Quaternion that turns one unit vector into another. */
function turn(a: Vector, b: Vector) {
  const w = 1 + a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  if (w < 1e-9) {
    return { x: a[2], y: a[0], z: a[1], w: 0 }; // half a turn; for an axis of the frame this one is square to it
  }
  const n = Math.sqrt(2 * w);
  return {
    x: (a[1] * b[2] - a[2] * b[1]) / n, y: (a[2] * b[0] - a[0] * b[2]) / n, z: (a[0] * b[1] - a[1] * b[0]) / n, w: n / 2,
  };
}

function rod(a: Vector, b: Vector, radius: number, color: Color): CylinderPrimitive {
  const along = plus(b, a, -1);
  const length = Math.max(norm(along), 1e-6);
  const unit: Vector = [along[0] / length, along[1] / length, along[2] / length];
  return {
    pose: { position: point(plus(a, along, 0.5)), orientation: turn([0, 0, 1], unit) },
    size: { x: 2 * radius, y: 2 * radius, z: length }, bottom_scale: 1, top_scale: 1, color,
  };
}

function line(points: Point3[], thickness: number, color: Color): LinePrimitive {
  const pose = { position: { x: 0, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } };
  return { type: STRIP, pose, thickness, scale_invariant: true, points, color, colors: [], indices: [] };
}

function words(text: string, position: Vector): TextPrimitive {
  const pose = { position: point(position), orientation: { x: 0, y: 0, z: 0, w: 1 } };
  return { pose, billboard: true, font_size: 14, scale_invariant: true, color: TEXT, text };
}

function arrow(from: Vector, along: Vector): ArrowPrimitive {
  const length = norm(along);
  const unit: Vector = [along[0] / length, along[1] / length, along[2] / length];
  return {
    pose: { position: point(from), orientation: turn([1, 0, 0], unit) },
    shaft_length: 0.75 * length, shaft_diameter: 0.02, head_length: 0.25 * length, head_diameter: 0.05, color: FORCE,
  };
}

export default function script(event: Input<"/params"> | Input<"/tick">): SceneUpdate {
  if (event.topic === "/params") {
    set = event.message;
    return UNCHANGED;
  }
  const now = event.receiveTime.sec + 1e-9 * event.receiveTime.nsec;
  if (set == undefined || (now > drawn && now < drawn + PERIOD)) {
    return UNCHANGED;
  }
  drawn = now;
  const tick = event.message;
  const arm = set.config.vehicle.arm;
  const rotors = set.config.vehicle.rotors;
  const pipe = set.config.pipe;

  const R = tick.outputs.estimate.R_WB;
  const p = vector(tick.outputs.estimate.p_WB);
  const world = (v: Vector): Vector => [
    p[0] + at(R, 0) * v[0] + at(R, 1) * v[1] + at(R, 2) * v[2],
    p[1] + at(R, 3) * v[0] + at(R, 4) * v[1] + at(R, 5) * v[2],
    p[2] + at(R, 6) * v[0] + at(R, 7) * v[1] + at(R, 8) * v[2],
  ];
  const toward = (angle: number): Vector => [Math.cos(angle), 0, Math.sin(angle)];
  const [theta1, theta2, theta3] = vector(tick.outputs.estimate.joints);
  const mount = vector(arm.mount);
  const elbow = plus(mount, toward(theta1), arm.link_1);
  const wrist = plus(elbow, toward(theta2), arm.link_2);
  const gripper = plus(wrist, toward(theta3), arm.gripper);
  const needle = plus(wrist, toward(theta3 + Math.PI / 2), arm.needle);

  const cylinders = [
    rod(world(mount), world(elbow), 0.012, ARM),
    rod(world(elbow), world(wrist), 0.012, ARM),
    rod(world(wrist), world(gripper), 0.009, ARM),
    rod(world(wrist), world(needle), 0.004, NEEDLE),
  ];
  if (tick.outputs.estimate.payload) {
    cylinders.push(rod(world(plus(gripper, [0, -0.05, 0])), world(plus(gripper, [0, 0.05, 0])), 0.02, SLEEVE));
  }
  for (const x of [1, -1]) {
    cylinders.push(rod(world([-x * rotors.arm_x, -rotors.arm_y, 0]), world([x * rotors.arm_x, rotors.arm_y, 0]), 0.01, GREY));
    for (const y of [1, -1]) {
      const hub: Vector = [x * rotors.arm_x, y * rotors.arm_y, 0.03];
      cylinders.push(rod(world(hub), world(plus(hub, [0, 0, 0.006])), rotors.radius, x > 0 ? NOSE : ROTOR));
    }
  }

  const heading = (pipe.heading_deg * Math.PI) / 180;
  const aside: Vector = [-Math.sin(heading), Math.cos(heading), 0];
  const axis = vector(pipe.position);
  const crack = plus(axis, [Math.cos(heading), Math.sin(heading), 0], -pipe.radius);
  cylinders.push(rod(plus(axis, aside, -pipe.length / 2), plus(axis, aside, pipe.length / 2), pipe.radius, PIPE));
  cylinders.push(rod(plus(crack, [0, 0, -0.03]), plus(crack, [0, 0, 0.03]), 0.004, CRACK));

  if (now < trailed || now > trailed + 10 * TRAIL_PERIOD) {
    trail = []; // the log was sought: what lies between was not seen
  }
  if (trail.length === 0 || now >= trailed + TRAIL_PERIOD) {
    trail = [...trail.slice(1 - TRAIL), point(p)];
    trailed = now;
  }

  const force = vector(tick.outputs.estimate.force_W);
  const length = METRES_PER_NEWTON * norm(force);
  const pushed = tick.outputs.estimate.in_contact && length > 0.01;
  const newtons = tick.outputs.estimate.contact_force.toFixed(2);
  return {
    deletions: [],
    entities: [{
      timestamp: event.receiveTime, frame_id: "W", id: "scene", lifetime: { sec: 0, nsec: 0 }, frame_locked: true, metadata: [],
      arrows: pushed ? [arrow(plus(world(gripper), force, METRES_PER_NEWTON), plus([0, 0, 0], force, -METRES_PER_NEWTON))] : [],
      cubes: [],
      spheres: [],
      cylinders,
      lines: [line([...trail, point(p)], 2, TRACK)],
      triangles: [],
      texts: [words(tick.outputs.phase + (pushed ? `, ${newtons} N` : ""), plus(p, [0, 0, 0.25]))],
      models: [],
    }],
  };
}
