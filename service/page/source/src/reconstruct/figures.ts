/** Figures of a result in plain words. */

import { figure } from '../colour'
import { h } from '../dom'
import { planeName } from '../grid'
import { type Sent, fileOf, warningsInWords } from '../places'
import { T } from '../text'
import type { Estimate, Plane, Summary } from '../types'

export function figures(summary: Summary): HTMLElement {
  const sd = summary.surface_sd
  return h(
    'dl',
    { class: 'figures' },
    ...card(T.figures.volume, `${figure(summary.volume_ml.value)} mL`, interval(summary.volume_ml, 'mL')),
    ...card(T.figures.area, `${figure(summary.area_cm2.value)} cm²`, interval(summary.area_cm2, 'cm²')),
    ...card(
      T.figures.sd,
      sd ? `${figure(sd.mean_mm)} mm` : T.figures.none,
      sd ? T.figures.sdMax(figure(sd.max_mm)) : T.figures.notAsked,
    ),
    ...card(
      T.figures.typicality,
      T.figures.percentile(summary.typicality_percentile),
      T.figures.typical(summary.typicality_percentile),
    ),
  )
}

export function warnings(summary: Summary, sent: Sent): HTMLElement {
  const sentences = [...warningsInWords(summary, sent), ...(summary.fit.converged ? [] : [T.figures.notConverged(summary.fit.message)])]
  if (sentences.length === 0) return h('p', { class: 'fine' }, T.figures.noWarnings)
  return h(
    'section',
    { class: 'warnings', 'aria-label': T.figures.warnings },
    h('h2', {}, T.figures.warnings),
    h('ul', {}, ...sentences.map((text) => h('li', {}, text))),
  )
}

/** How far each drawn slice and the result disagree. */
export function residuals(summary: Summary, sent: Sent): HTMLElement {
  const several = new Set(summary.residuals.map(({ plane }) => plane.stack)).size > 1
  const name = ({ stack, axis, index }: Plane): string => {
    const grid = sent.stacks?.[stack]
    const place = T.figures.slice(grid ? T.plane[planeName(grid, axis)] : T.figures.axis(axis), index + 1)
    return several ? T.place.ofFile(place, fileOf(sent, stack)) : place
  }
  const rows = summary.residuals.map(({ plane, disagreement }) =>
    h(
      'tr',
      {},
      h('th', { scope: 'row' }, name(plane)),
      h('td', {}, h('meter', { min: 0, max: 1, value: 1 - disagreement, 'aria-hidden': 'true' })),
      h('td', { class: 'number' }, figure(1 - disagreement)),
    ),
  )
  const head = h('tr', {}, ...T.figures.residualHead.map((text) => h('th', { scope: 'col' }, text)))
  return h(
    'details',
    { class: 'residuals' },
    h('summary', {}, T.figures.residuals(summary.residuals.length)),
    h('table', {}, h('thead', {}, head), h('tbody', {}, ...rows)),
  )
}

function card(name: string, value: string, note: string): HTMLElement[] {
  return [h('div', { class: 'figure' }, h('dt', {}, name), h('dd', { class: 'value' }, value), h('dd', { class: 'note' }, note))]
}

function interval(estimate: Estimate, unit: string): string {
  if (estimate.low === null || estimate.high === null) return T.figures.noInterval
  return T.figures.interval(figure(estimate.low), figure(estimate.high), unit)
}
