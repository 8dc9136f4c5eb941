// Writes player.min.js, the same bytes every time, and the licences of what is in it.
import { createHash } from "node:crypto";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

// A test compares this digest with the sources: a bundle that is older than they are is found without npm.
const sources = readdirSync(".").filter(name => /(?<!\.min)\.(js|json)$/.test(name)).sort();
const sha = createHash("sha256");
for (const name of sources) sha.update(`${name}\0`).update(readFileSync(name)).update("\0");
await build({
  entryPoints: ["main.js"], outfile: "player.min.js", bundle: true, minify: true, format: "iife", target: "es2022",
  charset: "ascii", legalComments: "none", banner: { js: `// sources ${sha.digest("hex")}` },
});
const PARTS = ["three", "@sparkjsdev/spark", "fflate"];
const texts = PARTS.map(name => {
  const { version, license, homepage } = JSON.parse(readFileSync(`node_modules/${name}/package.json`, "utf8"));
  const text = readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim();
  return `${name} ${version} (${license}) ${homepage ?? ""}\n\n${text}\n`;
});
writeFileSync("licences.txt", texts.join(`\n${"-".repeat(80)}\n\n`).replaceAll("\r", ""));
