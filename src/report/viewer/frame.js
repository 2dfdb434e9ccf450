// Talk of a framed view with the page around it, such as a notebook: selections go out, questions
// go out and come back with their number.

const waiting = new Map();
/// Longest wait for an answer, ms: a notebook answers when the cell that runs has ended.
const PATIENCE = 300_000;
let number = 0;

/// Sends a message to the outer page. A frame of `srcdoc` has no origin of its own to name.
export function tellOuter(message) {
  if (window.parent !== window) window.parent.postMessage({ splatvk: message }, "*");
}

/// Asks the outer page; resolves to {ok, body} as a server answers.
export function askOuter(text) {
  return new Promise((resolve) => {
    const own = ++number;
    waiting.set(own, resolve);
    tellOuter({ ask: text, number: own });
    setTimeout(() => {
      if (waiting.delete(own)) resolve({ ok: false, body: { error: "No answer from the page around this one." } });
    }, PATIENCE);
  });
}

window.addEventListener("message", ({ source, data }) => {
  const answer = source === window.parent && data?.splatvk;
  if (!answer || !waiting.has(answer.number)) return;
  waiting.get(answer.number)({ ok: answer.ok, body: answer.body });
  waiting.delete(answer.number);
});
