// A page whose scene is still being made: it takes new splats from the server, and the page of the
// finished scene in its place, without a jump of the camera.
import { Camera } from "splatvk/camera";

/// Time between two looks at the state of the server, ms.
const LOOK = 1500;

/// Follows the server until it has another page. `renew` loads the scene again, `say` shows a line,
/// `leave` is called before the page is loaded anew.
export function follow(manifest, { renew, say, leave }) {
  let [page, scene, notice] = [null, 0, ""];
  const look = async () => {
    let now;
    try {
      now = await (await fetch("state")).json();
    } catch {
      return say("The server has ended; this is the last it showed.");
    }
    page ??= now.page;
    // The finished page may have come before the first look.
    if (now.page !== page || !now.preview) {
      leave();
      return location.reload();
    }
    if (now.scene !== scene) {
      scene = now.scene;
      await renew().catch((error) => say(`The new splats could not be shown: ${error.message}`));
    }
    if (now.notice && now.notice !== notice) say((notice = now.notice));
    setTimeout(look, LOOK);
  };
  setTimeout(look, LOOK);
}

const KEY = "splatvk camera";

/// The camera, from one page of a scene to the next.
export const kept = {
  put({ camera }) {
    const { rotation, position, focal, shift, ratio, aspect, distance, cover } = camera;
    const state = { rotation, position, focal, shift, ratio, aspect, distance, cover };
    try {
      sessionStorage.setItem(KEY, JSON.stringify({ state, at: location.pathname }));
    } catch {
      // Without storage the next page begins with its own camera.
    }
  },
  take(motion) {
    let found;
    try {
      found = JSON.parse(sessionStorage.getItem(KEY));
      sessionStorage.removeItem(KEY);
    } catch {
      // A report that is opened as a file, or in a frame, may have no storage.
    }
    if (found?.at === location.pathname) motion.goTo(new Camera(found.state), -1, true);
  },
};
