// The two controls of a page. Without scripts the pictures stay as they are.

// A slider over two pictures: how much of the left one is seen.
for (const input of document.querySelectorAll(".compare input")) {
  const show = () => input.parentNode.style.setProperty("--at", input.value + "%")
  input.addEventListener("input", show)
  show()
}

// An environment at an exposure: linear radiance from RGBE (red, green and blue in the picture's upper half, the
// exponent in its lower half), times 2^EV, clipped, then sRGB's curve.
const srgb = x => x <= 0.0031308 ? 12.92 * x : 1.055 * Math.pow(x, 1 / 2.4) - 0.055

async function exposure(figure) {
  const [canvas, image, input, output] = ["canvas", "img", "input", "output"].map(name => figure.querySelector(name))
  await image.decode()
  const width = canvas.width = image.naturalWidth, height = canvas.height = image.naturalHeight / 2
  const reader = Object.assign(document.createElement("canvas"), {width, height: 2 * height}).getContext("2d")
  reader.drawImage(image, 0, 0)
  const packed = reader.getImageData(0, 0, width, 2 * height).data
  const radiance = new Float32Array(4 * width * height)
  for (let i = 0; i < radiance.length; i++)
    radiance[i] = packed[i] * 2 ** (packed[radiance.length + (i & ~3)] - 136)
  const context = canvas.getContext("2d"), shown = context.createImageData(width, height)
  const show = () => {
    const gain = 2 ** input.value
    for (let i = 0; i < radiance.length; i++)
      shown.data[i] = i % 4 === 3 ? 255 : 255 * srgb(Math.min(gain * radiance[i], 1))
    context.putImageData(shown, 0, 0)
    output.value = (input.value > 0 ? "+" : "") + Number(input.value).toFixed(1) + " EV"
  }
  input.addEventListener("input", show)
  show()
}
document.querySelectorAll(".exposure").forEach(exposure)
