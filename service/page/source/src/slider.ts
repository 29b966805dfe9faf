/** Sliders that tell their value. */

import { h, unique } from './dom'

export function slider(min: number, max: number, value: number, onChange: (value: number) => void, step = 1): HTMLInputElement {
  const input = h('input', { type: 'range', id: unique('slider'), min, max, step, value })
  input.addEventListener('input', () => onChange(Number(input.value)))
  return input
}

/** A slider's value in words: beside it for the eye, and as its own text for screen readers. */
export function valueOf(input: HTMLInputElement, words: (value: number) => string): HTMLElement {
  const place = h('output', { 'aria-hidden': 'true' })
  const tell = (): void => {
    place.textContent = words(Number(input.value))
    input.setAttribute('aria-valuetext', place.textContent)
  }
  for (const event of ['input', 'moved']) input.addEventListener(event, tell)
  tell()
  return place
}

/** Move a slider without telling whoever listens to its user. */
export function moveTo(input: HTMLInputElement, value: string): void {
  input.value = value
  input.dispatchEvent(new Event('moved'))
}

export function sliderField(label: string, input: HTMLInputElement, words: (value: number) => string): HTMLElement {
  return h('div', { class: 'field sliding' }, h('label', { for: input.id }, label), valueOf(input, words), input)
}
