// What both pages share: the view asked for in the address, as a three.js camera and canvas.
import * as THREE from "three";

export const asked = JSON.parse(new URLSearchParams(location.search).get("view"));

// world_from_cam has OpenCV's axes (right, down, forward); a three.js camera's are right, up, back.
const OPENCV_FROM_THREE = new THREE.Matrix4().makeScale(1, -1, -1);

// Clip coordinates of a pinhole camera whose integer pixels are pixel centres: an image spans -0.5 to width - 0.5.
function projection({ fx, fy, cx, cy, width, height, near, far }) {
  const right = (2 * (cx + 0.5)) / width - 1;
  const down = (2 * (cy + 0.5)) / height - 1;
  return new THREE.Matrix4().set(
    (2 * fx) / width, 0, -right, 0,
    0, (2 * fy) / height, down, 0,
    0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
    0, 0, -1, 0,
  );
}

export function makeCamera() {
  const fov = (2 * Math.atan(asked.height / (2 * asked.fy)) * 180) / Math.PI;
  const camera = new THREE.PerspectiveCamera(fov, asked.width / asked.height, asked.near, asked.far);
  camera.updateProjectionMatrix = () => {}; // a viewer must not put a symmetric one in its place
  camera.projectionMatrix.copy(projection(asked));
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  const pose = new THREE.Matrix4().set(...asked.world_from_cam.flat()).multiply(OPENCV_FROM_THREE);
  pose.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  return camera;
}

export function makeRenderer() {
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setPixelRatio(1);
  renderer.setSize(asked.width, asked.height);
  renderer.setClearColor(0x000000, 1);
  renderer.toneMapping = THREE.NoToneMapping;
  document.body.append(renderer.domElement);
  return renderer;
}

// Runs a page and tells the driver how it ended.
export async function finish(draw) {
  try {
    await draw();
    await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
    window.outcome = "drawn";
  } catch (error) {
    window.outcome = `failed: ${error?.stack ?? error}`;
  }
}
