// Formulae of a page, set by KaTeX, which lies beside this file.
document.addEventListener("DOMContentLoaded", () =>
  document.querySelectorAll(".arithmatex").forEach((element) => renderMathInElement(element)));
