/** A result: the coloured surface, its figures and warnings, its slices, files and link. */

import { type Api, isAbort, resultPath, sentence } from '../api'
import { scaleFromZero } from '../colour'
import { button, field, h, option, replace } from '../dom'
import { planeSurface } from '../drawn'
import { type Colouring, LookControls } from '../look'
import { readMz3 } from '../mesh'
import { resultLink } from '../route'
import { T } from '../text'
import type { DrawnPlanes, Summary } from '../types'
import type { SurfaceView } from '../viewer'
import { figures, residuals, warnings } from './figures'
import { ResultSlices } from './slices'

const MESH_FORMATS = ['ply', 'stl', 'obj', 'glb', '3mf', 'vtp', 'mz3']

export class ResultPanel {
  readonly element = h('div', { class: 'result' })
  readonly look: LookControls
  private readonly slices: ResultSlices

  constructor(
    private readonly api: Api,
    private readonly view: SurfaceView,
  ) {
    this.look = new LookControls(view)
    this.slices = new ResultSlices(api)
  }

  /** The surface first; slices follow once it is on the screen. */
  async show(summary: Summary, drawn: DrawnPlanes | null, files: string[], signal: AbortSignal): Promise<void> {
    const surface = readMz3(await this.api.bytes(resultPath(summary.id, '/mesh?format=mz3&space=RAS'), signal))
    const colouring: Colouring | null = surface.scalars && {
      name: T.figures.sdShort,
      label: T.figures.sdLegend,
      unit: 'mm',
      scale: scaleFromZero(surface.scalars),
    }
    const planes = drawn ? planeSurface(drawn) : null
    await this.view.show(surface, this.look.begin(colouring, planes !== null), planes)
    signal.throwIfAborted()
    const sent = { stacks: drawn?.stacks ?? null, files }
    replace(
      this.element,
      figures(summary),
      warnings(summary, sent),
      this.slices.element,
      residuals(summary, sent),
      this.keeping(summary),
    )
    const uncertain = summary.uncertainty !== 'none'
    this.slices.show(summary.id, uncertain, drawn, signal).catch((fault: unknown) => {
      if (!isAbort(fault)) replace(this.slices.element, h('p', { role: 'alert' }, sentence(fault)))
    })
  }

  private keeping(summary: Summary): HTMLElement {
    return h('section', { class: 'keeping' }, this.downloads(summary), this.link(summary), this.origin(summary))
  }

  private downloads(summary: Summary): HTMLElement {
    const uncertain = summary.uncertainty !== 'none'
    const parts: [string, string, string][] = [
      ...MESH_FORMATS.map((format): [string, string, string] => [`/mesh?format=${format}`, `surface.${format}`, T.files.mesh(format)]),
      ['/segmentation', 'segmentation.nii.gz', T.files.segmentation],
      ['/occupancy', 'occupancy.nii.gz', T.files.occupancy],
      ...(uncertain ? ([['/uncertainty', 'entropy.nii.gz', T.files.entropy], ['/uncertainty?kind=surface_sd', 'surface_sd.json', T.files.sd]] as [string, string, string][]) : []),
      ['', 'summary.json', T.files.summary],
    ]
    const choice = h('select', {}, ...parts.map(([, , label], n) => option(String(n), label)))
    const told = h('p', { role: 'status', class: 'hint' })
    const save = (): void => {
      const [part, name] = parts[Number(choice.value)]!
      this.api.download(resultPath(summary.id, part), name).then(
        () => (told.textContent = T.files.saved(name)),
        (fault: unknown) => (told.textContent = sentence(fault)),
      )
    }
    return h('div', { class: 'downloads' }, field(T.files.title, choice), button(T.files.download, save), told)
  }

  private link(summary: Summary): HTMLElement {
    const address = h('input', { type: 'text', readonly: true, value: resultLink(summary.id) })
    const until = h('p', { class: 'hint' }, T.link.until(new Date(summary.expires)))
    const told = h('p', { role: 'status', class: 'hint' })
    const copy = async (): Promise<void> => {
      told.textContent = (await copied(address)) ? T.link.copied : T.link.selected
    }
    return h('div', { class: 'downloads' }, field(T.link.title, address), button(T.link.copy, () => void copy()), until, told)
  }

  private origin(summary: Summary): HTMLElement {
    return h('p', { class: 'hint' }, T.madeBy(summary.model.name, summary.model.version, summary.observations, summary.fit.iterations))
  }
}

/** Whether the text of a field was copied. Browsers have the newer way only where the page came by HTTPS or from here. */
async function copied(field: HTMLInputElement): Promise<boolean> {
  field.select()
  try {
    await navigator.clipboard.writeText(field.value)
    return true
  } catch {
    return document.execCommand('copy')
  }
}
