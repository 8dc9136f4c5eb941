// Writes player.min.js, the same bytes every time, and the licences of what is in it.
import { readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

await build({
  entryPoints: ["main.js"], outfile: "player.min.js", bundle: true, minify: true, format: "iife", target: "es2022",
  charset: "ascii", legalComments: "none",
});
const PARTS = ["three", "@sparkjsdev/spark", "fflate"];
const texts = PARTS.map(name => {
  const { version, license, homepage } = JSON.parse(readFileSync(`node_modules/${name}/package.json`, "utf8"));
  return `${name} ${version} (${license}) ${homepage ?? ""}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}\n`;
});
writeFileSync("licences.txt", texts.join(`\n${"-".repeat(80)}\n\n`).replaceAll("\r", ""));
