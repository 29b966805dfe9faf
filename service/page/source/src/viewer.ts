/** A surface that can be turned, coloured, faded and cut; the drawing is done by NiiVue. */

import { NVMesh, Niivue, SHOW_RENDER, SLICE_TYPE } from '@niivue/niivue'
import { DRAWN, PLAIN, type Rgb, type Scale, vertexColours } from './colour'
import { h } from './dom'
import { type Surface, cut, extents } from './mesh'
import { T } from './text'
import { onTheme } from './theme'
import type { Vec3 } from './types'

export interface Look {
  /** Colours of the scalars; plain without. */
  scale: Scale | null
  opacity: number
  /** World axis of the clip plane and its place from 0 to 1 along it; 1 leaves the surface whole. */
  clip: { axis: 0 | 1 | 2; place: number }
  planes: boolean
}

export const PLAIN_LOOK: Look = { scale: null, opacity: 1, clip: { axis: 0, place: 1 }, planes: false }
/** Even light from the viewer, so that colours stay those of the legend; the inside of a cut surface is darker. */
const SHADER = `#version 300 es
precision highp int;
precision highp float;
uniform float opacity;
in vec4 vClr;
in vec3 vN;
out vec4 color;
void main() {
  float facing = dot(normalize(vN), normalize(vec3(0.25, 0.45, -1.0)));
  float light = facing < 0.0 ? 0.45 - 0.1 * facing : 0.62 + 0.4 * facing;
  color = vec4(min(vClr.rgb * light, 1.0), opacity);
}`
const START: [number, number] = [130, 20]
/** Shapes are smaller where the view is narrow, so that they do not reach beyond its sides. */
const NARROW_SIZE = 0.78
const NAMES = ['surface', 'planes', 'frame']

export class SurfaceView {
  readonly element: HTMLElement
  private readonly canvas: HTMLCanvasElement
  private readonly niivue: Niivue
  private ready: Promise<unknown> | null = null
  private surface: Surface | null = null
  private planes: Surface | null = null
  private frame: Surface | null = null
  private look = PLAIN_LOOK
  private shader = 0
  private readonly size: number
  private narrow = false

  constructor(label: string, options: { cube?: boolean; size?: number } = {}) {
    this.canvas = h('canvas', { tabindex: 0, role: 'img', 'aria-label': `${label} ${T.turnByKeys}` })
    this.element = h('div', { class: 'surface-view' }, this.canvas)
    this.niivue = new Niivue({
      backColor: [0, 0, 0, 1],
      dragAndDropEnabled: false,
      isColorbar: false,
      isOrientationTextVisible: false,
      isOrientCube: options.cube ?? true,
      loadingText: '',
      logLevel: 'error',
      multiplanarShowRender: SHOW_RENDER.ALWAYS,
      show3Dcrosshair: false,
      viewModeHotKey: '',
      clipPlaneHotKey: '',
      cycleClipPlaneHotKey: '',
    })
    this.size = options.size ?? 1
    this.canvas.addEventListener('keydown', (event) => this.turnByKey(event))
  }

  async show(surface: Surface | null, look: Look, planes: Surface | null = null, frame: Surface | null = null): Promise<void> {
    Object.assign(this, { surface, look, planes, frame })
    await this.start()
    this.fit()
    this.draw()
  }

  /** The same surface in another look. */
  restyle(look: Look): void {
    this.look = look
    if (this.ready) this.draw()
  }

  /** Make everything ready to draw; the first time it takes longer than any drawing. */
  start(): Promise<unknown> {
    this.ready ??= this.niivue.attachToCanvas(this.canvas, true).then(() => {
      this.niivue.setSliceType(SLICE_TYPE.RENDER)
      this.reset()
      this.shader = this.niivue.setCustomMeshShader(SHADER, 'Even')
      onTheme(() => this.paintBack())
    })
    return this.ready
  }

  reset(): void {
    this.niivue.setScale(this.size * (this.narrow ? NARROW_SIZE : 1))
    this.niivue.setRenderAzimuthElevation(...START)
  }

  private fit(): void {
    const narrow = this.canvas.clientWidth < this.canvas.clientHeight
    if (narrow === this.narrow) return
    this.narrow = narrow
    this.reset()
  }

  /** Turn and size of another view follow this one's, and the other way round. */
  link(other: SurfaceView): void {
    this.niivue.broadcastTo(other.niivue, { '3d': true, '2d': false })
    other.niivue.broadcastTo(this.niivue, { '3d': true, '2d': false })
  }

  /** A surface drawn onto another canvas; whole at once, since others may be painted by the same view. */
  async paint(surface: Surface, look: Look, frame: Surface, target: HTMLCanvasElement): Promise<void> {
    await this.start()
    Object.assign(this, { surface, look, planes: null, frame })
    this.draw()
    this.niivue.drawScene()
    target.getContext('2d')!.drawImage(this.canvas, 0, 0, target.width, target.height)
  }

  private paintBack(): void {
    const parts = getComputedStyle(this.element).getPropertyValue('--view').trim().split(/\s+/).map(Number)
    this.niivue.opts.backColor = [...parts.map((part) => part / 255), 1]
    this.element.style.backgroundColor = ''
    this.niivue.drawScene()
  }

  private draw(): void {
    const old = this.niivue.meshes
    const gl = this.niivue.gl
    this.niivue.meshes = this.parts().map(([surface, colours, opacity, name]) => {
      const mesh = new NVMesh(surface.vertices, surface.faces, name, colours, opacity, true, gl)
      mesh.meshShaderIndex = this.shader
      return mesh
    })
    for (const mesh of old) mesh.unloadMesh(gl)
    this.niivue.updateGLVolume()
    this.canvas.dataset['drawn'] = String(Number(this.canvas.dataset['drawn'] ?? 0) + 1)
  }

  /** What is opaque comes first, so that it shows through what is not. */
  private parts(): [Surface, Uint8Array, number, string][] {
    const parts: [Surface, Uint8Array, number, string][] = []
    if (this.planes && (this.look.planes || !this.surface)) parts.push([this.planes, plain(DRAWN), 1, NAMES[1]!])
    if (this.frame) parts.push([this.frame, plain(PLAIN), 1, NAMES[2]!])
    const shown = this.surface && this.clipped(this.surface)
    if (shown && shown.faces.length > 0) {
      const { scale, opacity } = this.look
      const colours = scale && shown.scalars ? vertexColours(shown.scalars, scale) : plain(PLAIN)
      parts.push([shown, colours, opacity, NAMES[0]!])
    }
    return parts
  }

  private clipped(surface: Surface): Surface {
    const { axis, place } = this.look.clip
    if (place >= 1) return surface
    const [low, high] = extents(surface)
    const normal: Vec3 = [0, 0, 0]
    normal[axis] = 1
    return cut(surface, normal, low[axis]! + (high[axis]! - low[axis]!) * place)
  }

  private turnByKey(event: KeyboardEvent): void {
    const turns: Record<string, Vec3> = {
      ArrowLeft: [-10, 0, 0],
      ArrowRight: [10, 0, 0],
      ArrowUp: [0, 10, 0],
      ArrowDown: [0, -10, 0],
      '+': [0, 0, 1.15],
      '=': [0, 0, 1.15],
      '-': [0, 0, 1 / 1.15],
    }
    const turn = turns[event.key]
    if (!turn) return
    event.preventDefault()
    event.stopImmediatePropagation()
    const { renderAzimuth, renderElevation, volScaleMultiplier } = this.niivue.scene
    if (turn[2]) this.niivue.setScale(Math.min(Math.max(volScaleMultiplier * turn[2], 0.4), 5))
    else this.niivue.setRenderAzimuthElevation(renderAzimuth + turn[0], renderElevation + turn[1])
  }
}

function plain(colour: Rgb): Uint8Array {
  return new Uint8Array([...colour, 255])
}
