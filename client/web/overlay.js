// The tracked points over the picture.

/** Lines along what matters: lips, brows, lids and the face's outline, by the tracker's numbering. */
const LINES = [
  [61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185, 61],
  [78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191, 78],
  [46, 53, 52, 65, 55], [276, 283, 282, 295, 285],
  [33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246, 33],
  [263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466, 263],
];
/** Middles of the irises and a point on the edge of each. */
const IRISES = [[468, 469], [473, 474]];

/**
 * @param {HTMLCanvasElement} canvas
 * @param {Float32Array | null} points null clears
 * @param {number} width of the picture @param {number} height of the picture
 */
export function drawPoints(canvas, points, width, height) {
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.clearRect(0, 0, width, height);
  if (!points) return;
  const size = Math.max(1, width / 500);
  context.fillStyle = "#ece9e499";
  for (let i = 0; i < 468; i += 1) context.fillRect(points[3 * i] - size / 2, points[3 * i + 1] - size / 2, size, size);
  context.strokeStyle = "#e9a178";
  context.lineWidth = 1.4 * size;
  context.lineJoin = "round";
  for (const line of LINES) {
    context.beginPath();
    for (const i of line) context.lineTo(points[3 * i], points[3 * i + 1]);
    context.stroke();
  }
  context.strokeStyle = "#7fb4e8";
  for (const [middle, edge] of IRISES) {
    const radius = Math.hypot(points[3 * edge] - points[3 * middle], points[3 * edge + 1] - points[3 * middle + 1]);
    context.beginPath();
    context.arc(points[3 * middle], points[3 * middle + 1], radius, 0, 2 * Math.PI);
    context.stroke();
  }
}

/**
 * Heights of a few points over the nose bridge, in distances of the eyes' outer corners, positive up: right brow, left brow,
 * upper lip, lower lip, right corner of the mouth, left corner.
 * @param {Float32Array} points
 * @returns {number[]}
 */
export function keyHeights(points) {
  const distance = Math.hypot(points[3 * 33] - points[3 * 263], points[3 * 33 + 1] - points[3 * 263 + 1]) || 1;
  return [105, 334, 0, 17, 61, 291].map((i) => (points[3 * 168 + 1] - points[3 * i + 1]) / distance);
}
