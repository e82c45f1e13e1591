// Arrays inside a page.
"use strict";

/** The bytes of an element that `array_element` in page.py wrote. Throws where it is missing or damaged. */
async function bytesOf(id) {
  const element = document.getElementById(id);
  if (!element) throw new Error(`this file is incomplete: it lacks "${id}"`);
  let text;
  try {
    text = atob(element.textContent.trim());
  } catch {
    throw new Error(`this file is damaged: "${id}" is not base64`);
  }
  const packed = Uint8Array.from(text, letter => letter.charCodeAt(0));
  let planes;
  try {
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    planes = new Uint8Array(await new Response(stream).arrayBuffer());
  } catch {
    throw new Error(`this file is damaged: "${id}" cannot be decompressed`);
  }
  return interleaved(planes, Number(element.dataset.itemsize));
}

/** Bytes of equal significance, plane after plane, put back number by number. */
function interleaved(planes, itemsize) {
  const bytes = new Uint8Array(planes.length), count = planes.length / itemsize;
  for (let plane = 0; plane < itemsize; plane++)
    for (let i = 0; i < count; i++) bytes[i * itemsize + plane] = planes[plane * count + i];
  return bytes;
}
