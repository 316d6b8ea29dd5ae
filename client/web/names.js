// ARKit's expression shapes by region, and poses of the six expressions.

/** @type {{title: string, names: string[]}[]} */
export const REGIONS = [
  { title: "Brows", names: ["browInnerUp", "browOuterUpLeft", "browOuterUpRight", "browDownLeft", "browDownRight"] },
  {
    title: "Eyes",
    names: ["eyeBlinkLeft", "eyeBlinkRight", "eyeWideLeft", "eyeWideRight", "eyeSquintLeft", "eyeSquintRight"],
  },
  {
    title: "Gaze",
    names: [
      "eyeLookUpLeft", "eyeLookUpRight", "eyeLookDownLeft", "eyeLookDownRight",
      "eyeLookInLeft", "eyeLookInRight", "eyeLookOutLeft", "eyeLookOutRight",
    ],
  },
  { title: "Nose and cheeks", names: ["noseSneerLeft", "noseSneerRight", "cheekPuff", "cheekSquintLeft", "cheekSquintRight"] },
  { title: "Jaw", names: ["jawOpen", "jawForward", "jawLeft", "jawRight"] },
  {
    title: "Mouth",
    names: [
      "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight",
      "mouthStretchLeft", "mouthStretchRight", "mouthLeft", "mouthRight",
    ],
  },
  {
    title: "Lips",
    names: [
      "mouthPucker", "mouthFunnel", "mouthClose", "mouthRollUpper", "mouthRollLower", "mouthShrugUpper", "mouthShrugLower",
      "mouthPressLeft", "mouthPressRight", "mouthUpperUpLeft", "mouthUpperUpRight", "mouthLowerDownLeft", "mouthLowerDownRight",
    ],
  },
  { title: "Tongue", names: ["tongueOut"] },
];

/** All 52. */
export const SHAPES = REGIONS.flatMap((region) => region.names);

/** The shape on the other side that goes with this one; itself where there is none. Eyes that look aside look the same way. @param {string} name */
export function mirrored(name) {
  if (/^(jaw|mouth)(Left|Right)$/.test(name)) return name;
  if (name.startsWith("eyeLookIn")) name = name.replace("In", "Out");
  else if (name.startsWith("eyeLookOut")) name = name.replace("Out", "In");
  if (name.endsWith("Left")) return `${name.slice(0, -4)}Right`;
  if (name.endsWith("Right")) return `${name.slice(0, -5)}Left`;
  return name;
}

/** `eyeLookUpLeft` as `look up, left`. @param {string} name */
export function label(name) {
  const words = name.replace(/^(eye|mouth|brow|nose)(?=[A-Z])(?!Left$|Right$)/, "").replace(/([A-Z])/g, " $1").trim().toLowerCase();
  const text = words.replace(/ (left|right)$/, ", $1");
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/**
 * Weights of the faces that go with the six expressions; tuned by eye on the built-in head.
 * @type {Record<string, Record<string, number>>}
 */
export const EXPRESSION_FACES = {
  joy: both({ mouthSmile: 0.9, cheekSquint: 0.8, mouthDimple: 0.2, eyeSquint: 0.3, browOuterUp: 0.45 }),
  surprise: { browInnerUp: 0.9, jawOpen: 0.35, ...both({ browOuterUp: 0.9, eyeWide: 0.7 }) },
  fear: { browInnerUp: 0.95, jawOpen: 0.18, ...both({ browOuterUp: 0.3, browDown: 0.3, eyeWide: 0.9, mouthStretch: 0.7 }) },
  anger: both({ browDown: 1, noseSneer: 0.4, eyeSquint: 0.4, mouthPress: 0.6, mouthFrown: 0.35 }),
  disgust: {
    mouthShrugLower: 0.4,
    ...both({ noseSneer: 1, mouthUpperUp: 0.7, browDown: 0.5, cheekSquint: 0.5, eyeSquint: 0.4, mouthFrown: 0.3 }),
  },
  sad: { browInnerUp: 0.95, mouthShrugLower: 0.6, ...both({ browDown: 0.15, mouthFrown: 0.8, eyeLookDown: 0.3, eyeSquint: 0.2 }) },
};

/** @param {Record<string, number>} stems @returns {Record<string, number>} */
function both(stems) {
  return Object.fromEntries(Object.entries(stems).flatMap(([stem, value]) => [[`${stem}Left`, value], [`${stem}Right`, value]]));
}
