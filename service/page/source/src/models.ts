/** The choice among the loaded models. */

import { option } from './dom'
import { T } from './text'
import type { ModelSummary } from './types'

/** The model of the example; chosen where nothing else is asked for. */
export const EXAMPLE_MODEL = 'hippocampus'

export function modelOptions(models: ModelSummary[], wanted: string | null = null): HTMLOptionElement[] {
  const chosen = models.some((model) => model.name === wanted) ? wanted : EXAMPLE_MODEL
  return models.map((model) => option(model.name, T.request.modelName(model), model.name === chosen))
}
