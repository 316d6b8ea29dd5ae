// The face tracker: MediaPipe's face mesh with irises, 478 points, from this server's own files.

/** Where the server keeps the tracker's files. */
const FILES = "/face_mesh/";
/** How long loading may take, milliseconds: ten megabytes over a slow network. */
const PATIENCE = 60_000;

/** Finds the points of one face in pictures. */
export class FaceTracker {
  /** @param {any} mesh */
  constructor(mesh) {
    this.mesh = mesh;
    /** @type {{x: number, y: number, z: number}[] | null} */
    this.found = null;
    mesh.onResults((/** @type {any} */ results) => {
      this.found = results.multiFaceLandmarks?.[0] ?? null;
    });
  }

  /** Loads the tracker. @returns {Promise<FaceTracker>} rejects with an Error of one clear sentence */
  static async load() {
    if (!("FaceMesh" in window)) await addScript(`${FILES}face_mesh.js`);
    const mesh = new (/** @type {any} */ (window).FaceMesh)({ locateFile: (/** @type {string} */ file) => FILES + file });
    const tracker = new FaceTracker(mesh);
    /** @type {number | undefined} */
    let timer;
    const tooLate = new Promise((_, reject) => (timer = setTimeout(() => reject(new Error("it took longer than a minute")), PATIENCE)));
    try {
      // The least confidence of a detection stays as it is: this version of the tracker aborts where it is set at all.
      const ready = mesh.initialize()
        .then(() => mesh.setOptions({ maxNumFaces: 1, refineLandmarks: true, minTrackingConfidence: 0.5, selfieMode: false }))
        .then(() => mesh.send({ image: blank() }));
      await Promise.race([ready, tooLate]);
    } catch (error) {
      throw new Error(`The face tracker cannot be loaded: ${error instanceof Error ? error.message : error}.`);
    } finally {
      clearTimeout(timer);
    }
    return tracker;
  }

  /**
   * Looks for a face in the video's present picture.
   * @param {HTMLVideoElement} video
   * @param {Float32Array} points receives x, y, z of each point: pixels of the video, z in the unit of x
   * @returns {Promise<boolean>} false where no face is seen
   */
  async find(video, points) {
    const { videoWidth: width, videoHeight: height } = video;
    await this.mesh.send({ image: video });
    const found = this.found;
    if (!found || 3 * found.length !== points.length) return false;
    found.forEach(({ x, y, z }, i) => {
      points[3 * i] = x * width;
      points[3 * i + 1] = y * height;
      points[3 * i + 2] = z * width;
    });
    return points.every(Number.isFinite);
  }
}

/** A picture without a face: what the tracker makes ready at its first picture, it makes ready before the first real one. */
function blank() {
  const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 64 });
  canvas.getContext("2d")?.fillRect(0, 0, 64, 64);
  return canvas;
}

/** @param {string} address @returns {Promise<void>} */
function addScript(address) {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = address;
    script.onload = () => resolve();
    script.onerror = () => reject(new Error("The face tracker is not in this server's page bundle. Build it with “cargo xtask web”."));
    document.head.append(script);
  });
}
