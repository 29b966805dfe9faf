/** The choice among the loaded models. */

import { type Api, Refusal } from './api'
import { option } from './dom'
import { T } from './text'
import type { ModelSummary } from './types'

/** The model of the example; chosen where nothing else is asked for. */
export const EXAMPLE_MODEL = 'hippocampus'

/** How long (ms) until a service that does not answer is asked again. */
const AGAIN_MS = 2000

/** The loaded models, once the service answers; `wait` is told each time that it does not. */
export async function loadedModels(api: Api, wait: (fault: unknown) => void): Promise<ModelSummary[]> {
  for (;;) {
    try {
      return await api.models()
    } catch (fault) {
      if (!(fault instanceof Refusal && fault.isPassing)) throw fault
      wait(fault)
    }
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS))
  }
}

export function modelOptions(models: ModelSummary[], wanted: string | null = null): HTMLOptionElement[] {
  const chosen = models.some((model) => model.name === wanted) ? wanted : EXAMPLE_MODEL
  return models.map((model) => option(model.name, T.request.modelName(model), model.name === chosen))
}
