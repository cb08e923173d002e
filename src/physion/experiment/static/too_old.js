/* Run only by browsers that know no modules. */
document.getElementById("too-old").hidden = false;
