/** What is sent: mask files and choices. */

import type { Api } from '../api'
import { button, field, h, option, replace } from '../dom'
import { EXAMPLE_MODEL, loadedModels, modelOptions } from '../models'
import type { Status } from '../status'
import { T } from '../text'

export const EXAMPLE = 'page/example_hippocampus.nii.gz'
const SUFFIXES = '.nii,.nii.gz,.gz,.nrrd,.seg.nrrd,.nhdr,.mha,.mhd,.dcm,application/dicom'

export class RequestForm {
  readonly element: HTMLElement
  files: File[] = []
  private readonly list = h('ul', { class: 'files', 'aria-label': T.request.files })
  private readonly model = h('select')
  private readonly uncertainty = choice(T.request.uncertainties)
  private readonly annotated = choice(T.request.annotatedRules)
  private readonly mirror = choice(T.request.mirrors)
  private readonly label = h('input', { type: 'text', inputmode: 'numeric', placeholder: T.request.labelAny })
  private readonly resolution = number(0.25, 10, 0.25, T.request.byModel)
  private readonly fidelity = number(0, 1, 0.1, T.request.byModel)
  private readonly seed = number(0, 2 ** 53 - 1, 1, '0')

  /** @param onChange called when what would be read of the masks changes. */
  constructor(
    private readonly api: Api,
    private readonly onChange: () => void,
  ) {
    for (const control of [this.annotated, this.label]) control.addEventListener('change', onChange)
    this.element = h('div', { class: 'request' }, this.drop(), this.list, ...this.choices())
    this.tellFiles()
  }

  async loadModels(status: Status): Promise<void> {
    replace(this.model, ...modelOptions(await loadedModels(this.api, status)))
  }

  get modelName(): string {
    return this.model.value
  }

  get slow(): boolean {
    return this.uncertainty.value === 'ensemble'
  }

  async takeExample(): Promise<void> {
    const bytes = await this.api.bytes(EXAMPLE)
    if ([...this.model.options].some((known) => known.value === EXAMPLE_MODEL)) this.model.value = EXAMPLE_MODEL
    this.setFiles([new File([bytes], 'hippocampus_three_slices.nii.gz')])
  }

  setFiles(files: File[]): void {
    this.files = files
    this.tellFiles()
    this.onChange()
  }

  /** What says which planes count as looked at. */
  planeChoices(): Record<string, string> {
    return { annotated: this.annotated.value, label: this.label.value.trim() }
  }

  allChoices(): Record<string, string> {
    return {
      ...this.planeChoices(),
      model: this.model.value,
      uncertainty: this.uncertainty.value,
      mirror: this.mirror.value,
      resolution_mm: this.resolution.value,
      fidelity: this.fidelity.value,
      seed: this.seed.value,
    }
  }

  private drop(): HTMLElement {
    const input = h('input', { type: 'file', multiple: true, accept: SUFFIXES, 'aria-label': T.request.choose })
    input.addEventListener('change', () => {
      this.setFiles([...this.files, ...(input.files ?? [])])
      input.value = ''
    })
    const zone = h('div', { class: 'drop' }, h('p', {}, T.request.drop), h('small', {}, T.request.formats), input)
    const mark = (on: boolean) => (event: DragEvent) => {
      event.preventDefault()
      zone.classList.toggle('over', on)
    }
    zone.addEventListener('dragover', mark(true))
    zone.addEventListener('dragleave', mark(false))
    zone.addEventListener('drop', (event) => {
      mark(false)(event)
      this.setFiles([...this.files, ...(event.dataTransfer?.files ?? [])])
    })
    return zone
  }

  private choices(): HTMLElement[] {
    return [
      field(T.request.model, this.model),
      field(T.request.uncertainty, this.uncertainty),
      h(
        'details',
        {},
        h('summary', {}, T.request.more),
        field(T.request.annotated, this.annotated),
        field(T.request.label, this.label, T.request.labelHint),
        field(T.request.fidelity, this.fidelity, T.request.fidelityHint),
        field(T.request.mirror, this.mirror),
        field(T.request.resolution, this.resolution),
        field(T.request.seed, this.seed),
      ),
    ]
  }

  private tellFiles(): void {
    replace(this.list, ...this.files.map((file) => this.fileItem(file)))
    this.list.hidden = this.files.length === 0
  }

  private fileItem(file: File): HTMLElement {
    const remove = (): void => this.setFiles(this.files.filter((other) => other !== file))
    const name = h('span', { class: 'name', title: file.name }, file.name)
    return h('li', {}, name, button(T.request.remove, remove, { class: 'quiet', 'aria-label': T.request.removeFile(file.name) }))
  }
}

function choice(labels: Record<string, string>): HTMLSelectElement {
  return h('select', {}, ...Object.entries(labels).map(([value, label]) => option(value, label)))
}

function number(min: number, max: number, step: number, placeholder: string): HTMLInputElement {
  return h('input', { type: 'number', min, max, step, placeholder })
}
