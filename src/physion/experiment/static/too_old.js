/* Run only by browsers without support for modules. */
document.getElementById("too-old").hidden = false;
