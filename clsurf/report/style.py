"""The frame and the style of a report's page, for light and dark screens and for paper."""

STYLE = """
:root { color-scheme: light dark; --ink: #1c2430; --quiet: #5b6675; --line: #d8dee6; --ground: #ffffff; --card: #f6f8fa;
  --c0: #2f6fb0; --c1: #e08a2c; --c2: #5a9e57; --c3: #a5569b; --c4: #8a8f98; }
@media screen and (prefers-color-scheme: dark) { :root { --ink: #e4e9f0; --quiet: #9aa6b5; --line: #38424f;
  --ground: #14181e; --card: #1d232b; --c0: #5b9bdc; --c1: #eba455; --c2: #7dbf79; --c3: #c57fbc; --c4: #a3a9b3; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem; max-width: 68rem; background: var(--ground); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 1rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 0 0 .6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; }
p { max-width: 48rem; color: var(--quiet); margin: .2rem 0 .8rem; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 1rem 1.2rem;
  margin: 0 0 1.2rem; break-inside: avoid; }
.part th { font-weight: 400; padding-left: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 0 0 .8rem; }
th, td { padding: .22rem .8rem .22rem 0; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; }
.facts th { white-space: nowrap; }
.numbers td, .numbers thead th:not(:first-child) { text-align: right; padding: .22rem 0 .22rem 1.4rem;
  white-space: nowrap; }
.facts { width: 100%; }
.facts td { width: 100%; overflow-wrap: anywhere; }
.pictures { display: flex; flex-wrap: wrap; gap: 1rem; margin-top: 1rem; }
figure { margin: 0; flex: 1 1 18rem; min-width: 0; max-width: 100%; }
img { display: block; max-width: 100%; height: auto; background: #fff; border: 1px solid var(--line); }
figcaption { color: var(--quiet); font-size: .85rem; }
svg { display: block; width: 100%; max-width: 46rem; height: auto; margin: 0 0 .8rem; }
svg text { font-size: 13px; fill: var(--ink); }
svg .label { fill: var(--quiet); }
.c0 { fill: var(--c0); } .c1 { fill: var(--c1); } .c2 { fill: var(--c2); }
.c3 { fill: var(--c3); } .c4 { fill: var(--c4); }
"""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title} - clsurf report</title>
<style>""" + STYLE.replace("{", "{{").replace("}", "}}") + """</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""
