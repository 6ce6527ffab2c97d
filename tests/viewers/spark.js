import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";

import { asked, finish, makeCamera, makeRenderer } from "./view.js";

// Ours are Gaussians with 0.3 px² added and no opacity taken off for it, drawn to 1/255, sorted by depth.
const OURS = {
  preBlurAmount: 0.3,
  blurAmount: 0,
  maxStdDev: Math.sqrt(2 * Math.log(255)),
  minAlpha: 1 / 255,
  sortRadial: false,
  accumExtSplats: true,
};

await finish(async () => {
  const renderer = makeRenderer();
  const camera = makeCamera();
  const scene = new THREE.Scene();
  const matched = asked.settings === "matched";
  const spark = new SparkRenderer({ renderer, autoUpdate: false, enableLod: false, ...(matched ? OURS : {}) });
  const splats = new SplatMesh({ url: asked.file, extSplats: matched });
  scene.add(spark, splats);
  await splats.initialized;
  renderer.render(scene, camera);
  await spark.update({ scene, camera }); // returns when the sort is done
  renderer.render(scene, camera);
  if (spark.activeSplats === 0) throw new Error("no Gaussian is drawn");
});
