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
    try {
      const reply = await fetch("state"), now = await reply.json();
      page ??= now.page;
      // The finished page may have come before the first look.
      if (now.page !== page || !now.preview) {
        leave();
        return location.reload();
      }
      if (now.scene !== scene) {
        scene = now.scene;
        await renew();
      }
      if (now.notice && now.notice !== notice) say((notice = now.notice));
    } catch {
      return say("The server has ended; this is the last it showed.");
    }
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
    sessionStorage.setItem(KEY, JSON.stringify({ state, at: location.pathname }));
  },
  take(motion) {
    // A report that is opened as a file may have no storage.
    const text = location.protocol.startsWith("http") ? sessionStorage.getItem(KEY) : null;
    if (!text) return;
    sessionStorage.removeItem(KEY);
    const { state, at } = JSON.parse(text);
    if (at === location.pathname) motion.goTo(new Camera(state), -1, true);
  },
};
