/** Colour ramps and their legends. */

import { h } from './dom'

export type Rgb = [number, number, number]

/** From certain to uncertain; told apart in grey and by the colour-blind. The same as in the service's GLB files. */
export const UNCERTAIN: Rgb[] = [
  [255, 245, 235],
  [241, 105, 19],
  [127, 39, 4],
]
/** The same on a dark ground. */
export const GLOWING: Rgb[] = [
  [30, 26, 64],
  [136, 34, 106],
  [227, 89, 51],
  [252, 255, 164],
]
/** From inside over none to outside. */
export const DIVERGING: Rgb[] = [
  [33, 102, 172],
  [146, 197, 222],
  [247, 247, 247],
  [244, 165, 130],
  [178, 24, 43],
]
export const PLAIN: Rgb = [222, 214, 200]
export const DRAWN: Rgb = [15, 134, 166]

export interface Scale {
  ramp: Rgb[]
  low: number
  high: number
}

export function colourAt(scale: Scale, value: number): Rgb {
  const last = scale.ramp.length - 1
  const span = scale.high - scale.low || 1
  const place = Math.min(Math.max((value - scale.low) / span, 0), 1) * last
  const n = Math.min(Math.floor(place), last - 1)
  const [a, b, share] = [scale.ramp[n]!, scale.ramp[n + 1]!, place - n]
  return [0, 1, 2].map((c) => Math.round(a[c]! * (1 - share) + b[c]! * share)) as Rgb
}

/** RGBA of each vertex. */
export function vertexColours(scalars: Float32Array, scale: Scale): Uint8Array {
  const colours = new Uint8Array(scalars.length * 4)
  scalars.forEach((value, n) => colours.set([...colourAt(scale, value), 255], 4 * n))
  return colours
}

/** From zero to the largest value, rounded up to two figures that are easily read. */
export function scaleFromZero(values: Float32Array): Scale {
  return { ramp: UNCERTAIN, low: 0, high: roundUp(values.reduce((a, b) => Math.max(a, b), 0)) }
}

export function scaleAroundZero(values: Float32Array): Scale {
  const high = roundUp(values.reduce((a, b) => Math.max(a, Math.abs(b)), 0))
  return { ramp: DIVERGING, low: -high, high }
}

/** A bar with its ends and middle, and what it measures. */
export function legend(scale: Scale, title: string, unit: string): HTMLElement {
  const bar = h('canvas', { class: 'bar', width: 160, height: 8, 'aria-hidden': 'true' })
  const context = bar.getContext('2d')!
  for (let x = 0; x < bar.width; x += 1) {
    const value = scale.low + ((scale.high - scale.low) * (x + 0.5)) / bar.width
    context.fillStyle = `rgb(${colourAt(scale, value).join(' ')})`
    context.fillRect(x, 0, 1, bar.height)
  }
  const ticks = [scale.low, (scale.low + scale.high) / 2, scale.high].map((v) => h('span', {}, figure(v)))
  return h('div', { class: 'legend' }, h('span', { class: 'name' }, `${title} (${unit})`), bar, h('div', { class: 'ticks' }, ...ticks))
}

export function figure(value: number): string {
  const size = Math.abs(value)
  const digits = size >= 100 ? 0 : size >= 10 ? 1 : 2
  return value.toFixed(digits).replace('-', '−')
}

function roundUp(value: number): number {
  if (!(value > 0)) return 1
  const unit = 10 ** Math.floor(Math.log10(value) - 1)
  return Math.ceil(value / unit - 1e-9) * unit
}
