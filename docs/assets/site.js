// On a phone, long parts of a page are folded; elsewhere they are open from the start.
document$.subscribe(() => {
  if (matchMedia("(max-width: 44.98em)").matches)
    for (const part of document.querySelectorAll("details.long")) part.open = false;
});
