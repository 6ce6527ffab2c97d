import * as GaussianSplats3D from "@mkkellogg/gaussian-splats-3d";

import { asked, finish, makeCamera, makeRenderer } from "./view.js";

await finish(async () => {
  const renderer = makeRenderer();
  const viewer = new GaussianSplats3D.Viewer({
    renderer,
    camera: makeCamera(),
    rootElement: document.body,
    selfDrivenMode: false,
    useBuiltInControls: false,
    sharedMemoryForWorkers: false,
    sceneRevealMode: GaussianSplats3D.SceneRevealMode.Instant,
    sphericalHarmonicsDegree: 2, // the most it knows; its own default leaves them out
  });
  await viewer.addSplatScene(asked.file, { showLoadingUI: false, progressiveLoad: false });
  const sorted = () => viewer.splatRenderReady && !viewer.sortRunning;
  for (let drawn = 0; drawn < 3; drawn += sorted() ? 1 : 0) {
    viewer.update();
    viewer.render();
    await new Promise((done) => setTimeout(done, 20));
  }
  await viewer.runSplatSort(true, true);
  while (!sorted()) await new Promise((done) => setTimeout(done, 20));
  viewer.update();
  viewer.render();
  if (viewer.splatRenderCount === 0) throw new Error("no Gaussian is drawn");
});
