// glb.mjs FOLDER: gltf-validator on every .glb in it; fails on an error, tells what it finds.
import { createRequire } from "node:module";
import { readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";
const validator = createRequire(process.env.TALUS_NPM + "/")("gltf-validator");
const files = readdirSync(process.argv[2], { recursive: true }).filter(name => name.endsWith(".glb"));
const found = {};
let errors = 0;
for (const name of files) {
    const report = await validator.validateBytes(new Uint8Array(readFileSync(join(process.argv[2], name))));
    errors += report.issues.numErrors;
    for (const message of report.issues.messages)
        found[`${["error", "warning", "information", "hint"][message.severity]} ${message.code}`] =
            (found[`${["error", "warning", "information", "hint"][message.severity]} ${message.code}`] || 0) + 1;
}
console.log(`${files.length} files, ${errors} errors ${JSON.stringify(found)}`);
process.exit(errors || !files.length ? 1 : 0);
