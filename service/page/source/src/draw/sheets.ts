/** Drawings in the order in which they were begun; a new one can be undone as a stroke can. */

import type { Backdrop } from './canvas'
import type { Drawing } from './drawing'

/** A drawing, and the image that lies under it. */
export interface Sheet {
  drawing: Drawing
  image: File | null
  backdrop: Backdrop | null
}

/** Each holds two bytes for every voxel. */
const MOST = 3

export class Sheets {
  private sheets: Sheet[] = []
  private at = -1

  get current(): Sheet | null {
    return this.sheets[this.at] ?? null
  }

  get canUndo(): boolean {
    return this.at > 0 || this.current?.drawing.canUndo === true
  }

  get canRedo(): boolean {
    return this.at + 1 < this.sheets.length || this.current?.drawing.canRedo === true
  }

  /** Nothing is drawn, and no image was chosen to draw on. */
  get isBlank(): boolean {
    return !this.current?.image && !this.current?.drawing.canUndo
  }

  /** A new sheet; the one before stays within reach if something was drawn on it. */
  begin(sheet: Sheet): void {
    const former = this.sheets.slice(0, this.at + 1).filter(({ drawing }) => drawing.canUndo)
    for (const { drawing } of former) drawing.settle()
    this.sheets = [...former, sheet].slice(-MOST)
    this.at = this.sheets.length - 1
  }

  /** Draw or erase on the current sheet; false where nothing changes. */
  apply(axis: number, index: number, voxels: Iterable<number>, value: 0 | 1): boolean {
    const changed = this.current?.drawing.apply(axis, index, voxels, value) === true
    if (changed) this.sheets.length = this.at + 1
    return changed
  }

  undo(): void {
    if (this.current?.drawing.canUndo) this.current.drawing.undo()
    else if (this.canUndo) this.at -= 1
  }

  redo(): void {
    if (this.current?.drawing.canRedo) this.current.drawing.redo()
    else if (this.canRedo) this.at += 1
  }
}
