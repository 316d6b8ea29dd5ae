// The camera: opening it, choosing another, and saying clearly why there is none.

/** What is asked of a camera. Trackers look at a few hundred pixels of face; more only costs time. */
const WANTED = { width: { ideal: 640 }, height: { ideal: 480 }, frameRate: { ideal: 30, max: 60 } };

/**
 * Opens a camera.
 * @param {string} deviceId empty for whichever faces the person
 * @returns {Promise<MediaStream>} rejects with an Error of one or two clear sentences
 */
export async function openCamera(deviceId) {
  if (!navigator.mediaDevices?.getUserMedia) {
    throw new Error(isSecureContext
      ? "This browser gives pages no camera."
      : "Browsers give the camera only to secure pages. Open this page by https, or on the same machine by http://localhost.");
  }
  const chosen = deviceId ? { deviceId: { exact: deviceId } } : { facingMode: { ideal: "user" } };
  try {
    return await navigator.mediaDevices.getUserMedia({ audio: false, video: { ...WANTED, ...chosen } });
  } catch (error) {
    if (deviceId && /** @type {DOMException} */ (error).name === "OverconstrainedError") return openCamera("");
    throw new Error(explain(/** @type {DOMException} */ (error)));
  }
}

/** @param {DOMException} error */
function explain(error) {
  switch (error.name) {
    case "NotAllowedError":
    case "SecurityError":
      return "The camera was not allowed. Allow it for this page in the browser's address bar, then start again.";
    case "NotFoundError":
    case "OverconstrainedError":
      return "No camera was found. Plug one in, then start again.";
    case "NotReadableError":
    case "AbortError":
      return "The camera is there but gives no picture. Perhaps another program uses it: close that, then start again.";
    default:
      return `The camera cannot be opened: ${error.message || error.name}.`;
  }
}

/**
 * The cameras there are; their names are known only once one has been allowed.
 * @returns {Promise<{id: string, name: string}[]>}
 */
export async function listCameras() {
  try {
    const devices = await navigator.mediaDevices.enumerateDevices();
    return devices.filter((device) => device.kind === "videoinput").map((device, i) => ({ id: device.deviceId, name: device.label || `Camera ${i + 1}` }));
  } catch {
    return [];
  }
}
