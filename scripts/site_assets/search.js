"use strict";
// INDEX is a list of {title, url, text}. Every word must occur; words in titles count most.
const box = document.getElementById("search");
const list = document.getElementById("found");
const menu = document.getElementById("menu");
const MOST = 20;
const REFERENCE = /^(api\/|scripts-results)/; // looked up by name: it stands behind the pages that explain

if (innerWidth <= 800) menu.open = false;

for (const link of menu.querySelectorAll("a")) {
  if (link.pathname === location.pathname) link.setAttribute("aria-current", "page");
}

const lowered = INDEX.map((entry) => ({ title: entry.title.toLowerCase(), text: entry.text.toLowerCase() }));

function score(k, words) {
  let total = 0;
  for (const word of words) {
    const inTitle = lowered[k].title.includes(word);
    if (!inTitle && !lowered[k].text.includes(word)) return 0;
    total += inTitle ? 10 : 1;
  }
  return (total / (1 + lowered[k].title.length / 200)) * (REFERENCE.test(INDEX[k].url) ? 0.1 : 1);
}

function around(k, word) {
  const at = Math.max(0, lowered[k].text.indexOf(word) - 40);
  return (at ? "… " : "") + INDEX[k].text.slice(at, at + 120);
}

function search() {
  const words = box.value.toLowerCase().split(/\s+/).filter(Boolean);
  list.replaceChildren();
  list.hidden = words.length === 0;
  menu.hidden = words.length > 0;
  if (words.length === 0) return;
  const scored = INDEX.map((_, k) => [score(k, words), k]).filter(([value]) => value > 0);
  scored.sort((a, b) => b[0] - a[0] || a[1] - b[1]);
  for (const [, k] of scored.slice(0, MOST)) {
    const item = document.createElement("li");
    const link = document.createElement("a");
    link.href = INDEX[k].url;
    link.textContent = INDEX[k].title;
    const note = document.createElement("small");
    note.textContent = around(k, words[0]);
    item.append(link, note);
    list.append(item);
  }
  if (scored.length === 0) list.textContent = "Nothing found.";
}

box.addEventListener("input", search);
document.addEventListener("keydown", (event) => {
  if (event.key === "/" && document.activeElement !== box) {
    event.preventDefault();
    box.focus();
  }
});
