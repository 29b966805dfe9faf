/** Volumes from and to NIfTI files. */

import { decompress, isCompressed, isNIFTI, readHeader, readImage } from 'nifti-reader-js'
import { T } from './text'
import type { Grid, Vec3 } from './types'

export interface Volume extends Grid {
  values: Float32Array
}

type Reader = (view: DataView, at: number, little: boolean) => number

/** How a value of each NIfTI data type is read, and its size in bytes. */
const READERS: Record<number, [number, Reader]> = {
  2: [1, (view, at) => view.getUint8(at)],
  4: [2, (view, at, little) => view.getInt16(at, little)],
  8: [4, (view, at, little) => view.getInt32(at, little)],
  16: [4, (view, at, little) => view.getFloat32(at, little)],
  64: [8, (view, at, little) => view.getFloat64(at, little)],
  256: [1, (view, at) => view.getInt8(at)],
  512: [2, (view, at, little) => view.getUint16(at, little)],
  768: [4, (view, at, little) => view.getUint32(at, little)],
}
const HEADER_BYTES = 352

/** The first volume of a NIfTI file; a sentence for anything else. */
export function readNifti(buffer: ArrayBuffer): Volume {
  try {
    return volumeOf(buffer)
  } catch (fault) {
    throw fault instanceof NotNifti ? fault : new Error(T.brokenNifti)
  }
}

class NotNifti extends Error {}

function volumeOf(buffer: ArrayBuffer): Volume {
  const data = isCompressed(buffer) ? decompress(buffer) : buffer
  const plain = data instanceof ArrayBuffer ? data : new Uint8Array(data).slice().buffer
  const header = isNIFTI(plain) ? readHeader(plain) : null
  const known = header && READERS[header.datatypeCode]
  if (!header || !known) throw new NotNifti(T.notNifti)
  const shape = [1, 2, 3].map((n) => Math.max(header.dims[n] ?? 1, 1)) as Vec3
  const [bytes, read] = known
  const view = new DataView(readImage(header, plain))
  const slope = header.scl_slope || 1
  const values = new Float32Array(shape[0] * shape[1] * shape[2])
  for (let n = 0; n < values.length; n += 1) values[n] = read(view, n * bytes, header.littleEndian) * slope + header.scl_inter
  return { shape, affine: header.affine, values }
}

/** A label map as an uncompressed NIfTI-1 file with its grid as sform (RAS mm). */
export function writeNifti(grid: Grid, labels: Uint8Array): Uint8Array<ArrayBuffer> {
  const file = new Uint8Array(HEADER_BYTES + labels.length)
  const view = new DataView(file.buffer)
  view.setInt32(0, 348, true)
  const dims = [3, ...grid.shape, 1, 1, 1, 1]
  dims.forEach((size, n) => view.setInt16(40 + 2 * n, size, true))
  view.setInt16(70, 2, true)
  view.setInt16(72, 8, true)
  for (let axis = 0; axis < 3; axis += 1) {
    const size = Math.hypot(grid.affine[0]![axis]!, grid.affine[1]![axis]!, grid.affine[2]![axis]!)
    view.setFloat32(80 + 4 * axis, size, true)
    grid.affine[axis]!.forEach((value, n) => view.setFloat32(280 + 16 * axis + 4 * n, value, true))
  }
  view.setFloat32(76, 1, true)
  view.setFloat32(108, HEADER_BYTES, true)
  view.setFloat32(112, 1, true)
  view.setUint8(123, 2)
  view.setInt16(254, 2, true)
  file.set([0x6e, 0x2b, 0x31, 0], 344)
  file.set(labels, HEADER_BYTES)
  return file
}
