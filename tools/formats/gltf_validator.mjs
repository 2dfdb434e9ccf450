// Report of gltf-validator on a file, as JSON on standard output.
import { validateBytes } from "gltf-validator";
import { readFileSync } from "node:fs";
import { dirname, join } from "node:path";

const file = process.argv[2];
const externalResourceFunction = async (uri) => new Uint8Array(readFileSync(join(dirname(file), decodeURIComponent(uri))));
const report = await validateBytes(new Uint8Array(readFileSync(file)), { maxIssues: 0, externalResourceFunction });
console.log(JSON.stringify(report.issues));
