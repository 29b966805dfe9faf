/** Controls of the pen. */

import { h } from '../dom'
import { slider, sliderField } from '../slider'
import { T } from '../text'
import type { Tool } from './pen'

/** @param steps what stands below the pen: buttons that take strokes back. */
export function toolChoices(tool: Tool, ...steps: HTMLElement[]): HTMLElement {
  const kinds = (['polygon', 'brush'] as const).map((kind) => kindChoice(tool, kind))
  const erase = h('input', { type: 'checkbox', 'data-tool': 'erase' })
  erase.addEventListener('change', () => (tool.erase = erase.checked))
  const radius = slider(0.5, 8, tool.radiusMm, (value) => (tool.radiusMm = value), 0.5)
  return h(
    'fieldset',
    { class: 'tools' },
    h('legend', {}, T.draw.tools),
    h('div', { class: 'row' }, ...kinds),
    h('label', { class: 'check' }, erase, T.draw.erase),
    sliderField(T.draw.radius, radius, T.mm),
    h('div', { class: 'row' }, ...steps),
  )
}

function kindChoice(tool: Tool, kind: Tool['kind']): HTMLElement {
  const radio = h('input', { type: 'radio', name: 'tool', value: kind, checked: kind === tool.kind })
  radio.addEventListener('change', () => (tool.kind = kind))
  return h('label', { class: 'check' }, radio, T.draw.kinds[kind])
}
