"use strict";
// The strip holds each picture once; sliders borrow its addresses, so the page carries none twice.
for (const article of document.querySelectorAll("[data-card]")) {
  const slider = article.querySelector(".slider");
  const buttons = [...article.querySelectorAll(".strip button")];
  if (!slider) continue;
  const pick = (kind) => buttons.find((button) => button.dataset.kind === kind);
  const [before, after] = slider.querySelectorAll("img");
  const show = (button) => {
    after.src = button.querySelector("img").src;
    after.alt = button.querySelector("img").alt;
    slider.querySelector(".right").textContent = button.dataset.label;
    for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
  };
  before.src = pick("photo").querySelector("img").src;
  show(pick("composite") || pick("clean") || pick("mask") || pick("photo"));
  for (const button of buttons) button.addEventListener("click", () => show(button));
}
// The filmstrip shows the cleaned photo where there is one; a click leads to its card.
for (const link of document.querySelectorAll("[data-film]")) {
  const card = document.getElementById("photo-" + link.dataset.film);
  const picture = (kind) => card.querySelector(`[data-kind=${kind}] img`);
  link.firstElementChild.src = (picture("composite") || picture("photo")).src;
}
const hero = document.querySelector("[data-hero]");
if (hero) {
  const source = document.getElementById(hero.dataset.hero);
  const picture = (kind) => source.querySelector(`[data-kind=${kind}] img`);
  const [before, after] = hero.querySelectorAll("img");
  before.src = picture("photo").src;
  after.src = picture("composite").src;
  after.alt = picture("composite").alt;
}
for (const slider of document.querySelectorAll(".slider")) {
  const range = slider.querySelector("input");
  const move = () => slider.style.setProperty("--cut", range.value + "%");
  range.addEventListener("input", move);
  move();
}
