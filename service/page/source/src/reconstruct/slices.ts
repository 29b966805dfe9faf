/** Dense segmentation and entropy over the slices of a result. */

import { type Api, resultPath } from '../api'
import { GLOWING, type Rgb, type Scale, colourAt, legend } from '../colour'
import { h, option, replace } from '../dom'
import { voxelCount, voxelNumber, voxelsOf } from '../grid'
import { type Volume, readNifti } from '../nifti'
import { type Over, type Paint, outline } from '../pane'
import { Sections, middleOf } from '../sections'
import { T } from '../text'
import type { DrawnPlanes } from '../types'

/** Larger grids are not fetched as they are: a finer look costs more than it shows. */
const MOST_VOXELS = 3_000_000
const OWN_SPACING_MM = 1
const ENTROPY: Scale = { ramp: GLOWING, low: 0, high: Math.LN2 }
const LEAST_ENTROPY = 0.02
const OBJECT: Rgb = [92, 108, 116]
const EDGE = '#8fe8ff'
const SEEN = '#7dff8a'

type Layer = 'both' | 'segmentation' | 'entropy'

export class ResultSlices {
  readonly element = h('section', { class: 'slices' })
  private readonly sections = new Sections()
  private readonly layer = h('select', {}, ...(['both', 'segmentation', 'entropy'] as const).map((name) => option(name, T.slices[name])))
  private readonly legendPlace = h('div', {})

  constructor(private readonly api: Api) {
    this.layer.setAttribute('aria-label', T.slices.show)
    const head = h('header', { class: 'row' }, h('h2', {}, T.slices.title), this.layer)
    replace(this.element, head, this.sections.element, this.legendPlace)
  }

  async show(id: string, uncertain: boolean, drawn: DrawnPlanes | null, signal: AbortSignal): Promise<void> {
    const grid = drawn?.stacks[0]
    const query = grid && voxelCount(grid) <= MOST_VOXELS ? '' : `spacing_mm=${OWN_SPACING_MM}`
    const fetchVolume = async (part: string): Promise<Volume> => readNifti(await this.api.bytes(resultPath(id, part), signal))
    const [labels, entropy] = await Promise.all([
      fetchVolume(`/segmentation?${query}`),
      uncertain ? fetchVolume(`/uncertainty?${query}`) : null,
    ])
    const over = edges(labels, query === '' ? drawn : null)
    const paint = (): Paint => painter(labels, entropy, this.layer.value as Layer)
    this.sections.show(labels, paint(), over, middleOf(labels, inside(labels)))
    this.layer.disabled = entropy === null
    this.layer.onchange = () => this.sections.repaint(paint(), over)
    replace(this.legendPlace, entropy && legend(ENTROPY, T.slices.entropyLegend, 'nat'), h('p', { class: 'hint' }, T.slices.hint))
  }
}

/** The object, and the entropy over it. */
function painter(labels: Volume, entropy: Volume | null, layer: Layer): Paint {
  return (voxel) => {
    const uncertain = entropy && layer !== 'segmentation' ? entropy.values[voxel]! : 0
    const inside = layer !== 'entropy' && labels.values[voxel]! > 0
    if (uncertain > LEAST_ENTROPY) return [...colourAt(ENTROPY, uncertain), 255]
    return inside ? [...OBJECT, 255] : null
  }
}

/** The object's edge, and on annotated slices that of the drawing. */
function edges(labels: Volume, drawn: DrawnPlanes | null): Over {
  return (context, pane) => {
    outline(context, pane, (voxel) => labels.values[voxel]! > 0, EDGE)
    const plane = drawn?.planes.find((p) => p.stack === 0 && p.axis === pane.layout.axis && p.index === pane.slice)
    if (!plane) return
    const voxels = new Set<number>()
    for (const index of voxelsOf(labels, plane)) voxels.add(voxelNumber(labels, index))
    outline(context, pane, (voxel) => voxels.has(voxel), SEEN)
  }
}

/** Numbers of the object's voxels. */
function* inside(labels: Volume): Generator<number> {
  for (let voxel = 0; voxel < labels.values.length; voxel += 1) if (labels.values[voxel]! > 0) yield voxel
}
