// Names of codes: phrases with their relevancy, and whether the best of them can be said.

/// Odds of a name over those of the next with another noun, from which on it is said. Phrases of
/// unlike things stand at 0.97 to 0.99 beside each other, a factor of three.
const CLEAR = 4;

const odds = ([, share]) => share / Math.max(1 - share, 1e-6);
const noun = ([phrase]) => phrase.slice(phrase.lastIndexOf(" ") + 1);

/// Phrases that fit a code best, of the text model and of the answers so far. At 0.5 and below, a
/// phrase fits no better than "object" or "stuff".
export function namesOf(levels, answers, level, code) {
  const all = new Map(levels[level].phrases[code] || []);
  answers.forEach((a) => all.set(a.text, a.relevancy[levels[level].codes][code]));
  return [...all].filter((name) => name[1] > 0.51).sort((a, b) => b[1] - a[1]).slice(0, 6);
}

/// Whether the best phrase is a name: all others with another noun fit far less.
export function isClear(names) {
  const other = names.find((name) => noun(name) !== noun(names[0]));
  return names.length > 0 && (!other || odds(names[0]) >= CLEAR * odds(other));
}

/// The first phrases in a line, for what may as well be something else.
export const perhaps = (names) => names.slice(0, 3).map(([phrase]) => phrase).join(", ");
