// A headless Chromium that draws in software, as on the machines of the tests.
import { chromium } from "playwright-core";
import { execFileSync } from "node:child_process";

const NAMES = [process.env.CHROMIUM, "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"].filter(Boolean);

/// Path of a Chromium, or null.
export function installed() {
  for (const name of NAMES) {
    try {
      return execFileSync("sh", ["-c", 'command -v "$1"', "sh", name]).toString().trim();
    } catch {
      // The next name.
    }
  }
  return null;
}

export const launch = () => chromium.launch({
  executablePath: installed(),
  args: ["--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-watchdog", "--hide-scrollbars"],
});
