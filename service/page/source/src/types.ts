/** What the service answers; names and units are those of the interface (RAS, mm). */

export type Vec3 = [number, number, number]

export interface Grid {
  shape: Vec3
  /** 4 x 4, by rows: voxel index to RAS mm. */
  affine: number[][]
}

export interface Plane {
  stack: number
  axis: number
  index: number
}

export interface DrawnPlane extends Plane {
  /** Foreground as [start, length] of the plane's voxels by rows, in-plane axes in ascending order. */
  runs: [number, number][]
}

/** Voxels beside each other along an axis. */
export interface Row {
  from: Vec3
  along: number
  length: number
}

export interface Stack extends Grid {
  part: string
}

export interface DrawnPlanes {
  stacks: Stack[]
  planes: DrawnPlane[]
}

export interface Estimate {
  value: number
  low: number | null
  high: number | null
}

export interface Summary {
  id: string
  created: string
  expires: string
  model: { name: string; version: string; digest: string }
  fit: { status: string; converged: boolean; message: string; iterations: number }
  uncertainty: 'laplace' | 'ensemble' | 'none'
  observations: number
  planes: Plane[]
  residuals: { plane: Plane; disagreement: number; mean_error: number }[]
  volume_ml: Estimate
  area_cm2: Estimate
  surface_sd: { mean_mm: number; max_mm: number } | null
  typicality_percentile: number
  warnings: string[]
}

export interface ModelSummary {
  name: string
  version: string
  structure: string
  digest: string
}

export interface ModelDescription extends ModelSummary {
  half_extent_mm: Vec3
  resolution_mm: number
  latent_size: number
  training_shapes: number
  licence: string
}

export interface Mode {
  rank: number
  sigma: number
  variance_explained: number
  cumulative_variance: number
}

export interface Problem {
  title: string
  status: number
  detail: string
  part?: string
}
