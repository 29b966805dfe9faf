/** Controls of how a surface is seen: colour, opacity, clip plane, drawn planes. */

import { type Scale, legend } from './colour'
import { button, field, h, option, replace } from './dom'
import { slider, sliderField } from './slider'
import { T } from './text'
import { type Look, PLAIN_LOOK, type SurfaceView } from './viewer'

export interface Colouring {
  name: string
  label: string
  unit: string
  scale: Scale
}

/** A surface with its controls and its legend. */
export class LookControls {
  readonly element = h('div', { class: 'look' })
  private look: Look = { ...PLAIN_LOOK }
  private readonly legendPlace = h('div', { class: 'legend-place' })

  constructor(private readonly view: SurfaceView) {}

  /** Show controls for what there is; returns the look that the surface begins with. */
  begin(colouring: Colouring | null, planes: boolean): Look {
    this.look = { ...PLAIN_LOOK, scale: colouring?.scale ?? null, planes: false }
    replace(
      this.element,
      colouring && this.colourField(colouring),
      sliderField(T.look.opacity, this.opacity(), T.percent),
      field(T.look.clipAxis, this.clipAxis()),
      sliderField(T.look.clipPlace, this.clipPlace(), T.percent),
      planes && this.planesField(),
      button(T.look.reset, () => this.view.reset(), { class: 'quiet' }),
    )
    this.tellLegend(colouring)
    return this.look
  }

  /** The legend, to be laid over the view. */
  get legend(): HTMLElement {
    return this.legendPlace
  }

  private change(part: Partial<Look>): void {
    this.look = { ...this.look, ...part }
    this.view.restyle(this.look)
  }

  private tellLegend(colouring: Colouring | null): void {
    replace(this.legendPlace, colouring && legend(colouring.scale, colouring.label, colouring.unit))
  }

  private colourField(colouring: Colouring): HTMLElement {
    const choice = h('select', {}, option('scalar', colouring.name), option('plain', T.look.plain))
    choice.addEventListener('change', () => {
      const chosen = choice.value === 'scalar' ? colouring : null
      this.change({ scale: chosen?.scale ?? null })
      this.tellLegend(chosen)
    })
    return field(T.look.colour, choice)
  }

  private opacity(): HTMLInputElement {
    return slider(10, 100, 100, (value) => this.change({ opacity: value / 100 }))
  }

  private clipAxis(): HTMLSelectElement {
    const choice = h('select', {}, ...T.look.clipAxes.map((label, axis) => option(String(axis), label)))
    choice.addEventListener('change', () => {
      this.change({ clip: { ...this.look.clip, axis: Number(choice.value) as 0 | 1 | 2 } })
    })
    return choice
  }

  private clipPlace(): HTMLInputElement {
    return slider(5, 100, 100, (value) => this.change({ clip: { ...this.look.clip, place: value / 100 } }))
  }

  private planesField(): HTMLElement {
    const box = h('input', { type: 'checkbox' })
    box.addEventListener('change', () => this.change({ planes: box.checked }))
    return h('label', { class: 'check' }, box, T.look.planes)
  }
}
