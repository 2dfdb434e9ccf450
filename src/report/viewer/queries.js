// Questions and their answers.
import { card } from "splatvk/card";
import { button } from "splatvk/controls";
import { askOuter, tellOuter } from "splatvk/frame";
import { namesOf, perhaps } from "splatvk/names";
import { find, levels, manifest, say, scene, state } from "splatvk/page";
import { show } from "splatvk/show";

export const answers = [...manifest.answers];

export async function ask(text) {
  text = text.trim();
  if (!text) return;
  let answer = answers.find((a) => a.text.toLowerCase() === text.toLowerCase());
  if (!answer) {
    if (!manifest.live) return say(manifest.ask_note);
    say("Looking …");
    try {
      const { ok, body } = manifest.framed ? await askOuter(text) : await askServer(text);
      if (!ok) return say(body.error);
      answer = body;
    } catch {
      return say("The server does not answer; is splatvk view still running?");
    }
    answers.push(answer);
    listQueries();
  }
  say("");
  state.selected = state.picked = null;
  scene.renderer.select(-1, []);
  setQuery(answer);
  if (manifest.framed) tellOuter({ selected: { level: answer.level, codes: answer.codes }, text: answer.text });
  show("relevancy");
}

async function askServer(text) {
  const reply = await fetch("query", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ text }) });
  return { ok: reply.ok, body: await reply.json() };
}

/// Whether an answer says that the thing is there.
export const isSure = (answer) => answer.found > 0 && answer.presence !== "unsure";

export function highlight(answer) {
  scene.renderer.answer(answer.relevancy, answer.level, answer.codes, !isSure(answer));
}

export function setQuery(answer) {
  state.query = answer;
  if (answer) {
    highlight(answer);
    find(".v-ask input").value = answer.text;
    const of = (k) => answer.relevancy[answer.level][k];
    const best = answer.codes.reduce((a, b) => (of(b) > of(a) ? b : a), answer.codes[0]);
    const as = answer.found ? `, among the ${levels[answer.level].title.toLowerCase()}` : "; the heat shows what is nearest";
    const found = answer.verdict[0].toUpperCase() + answer.verdict.slice(1) + as;
    const notes = (answer.notes ?? []).map((note) => `; ${note}`).join("");
    const time = answer.milliseconds === undefined ? "" : `, ${answer.milliseconds.toFixed(0)} ms`;
    const names = best === undefined ? [] : namesOf(levels, answers, answer.level, best);
    const others = names.filter(([phrase]) => phrase !== answer.text);
    card(answer.text, `${found}${notes}${time}`, isSure(answer) ? { names } : { doubt: perhaps(others) });
  }
  find(".v-chips").querySelectorAll("button").forEach((b) => b.setAttribute("aria-pressed", String(b.textContent === answer?.text)));
}

/// Forgets the answers of the server: the scene has changed.
export function forget() {
  answers.length = 0;
  setQuery(null);
  if (state.mode === "relevancy") show("colour");
  find(".v-card").hidden = true;
  listQueries();
}

export function listQueries() {
  const asked = (text) => answers.some((a) => a.text.toLowerCase() === text.toLowerCase());
  const open = manifest.suggested.filter((text) => !asked(text)).map((text) => button(text, () => ask(text), { "aria-pressed": "false" }));
  const chips = answers.slice(-6).map((a) => button(a.text, () => (state.query === a ? clear() : ask(a.text)), { "aria-pressed": "false" }));
  chips.push(...open);
  find(".v-chips").replaceChildren(...chips);
  find("datalist").replaceChildren(...answers.map((a) => Object.assign(document.createElement("option"), { value: a.text })));
}
