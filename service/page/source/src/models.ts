/** The choice among the loaded models. */

import { type Api, Refusal, sentence } from './api'
import { option } from './dom'
import type { Status } from './status'
import { T } from './text'
import type { ModelSummary } from './types'

/** The model of the example; chosen where nothing else is asked for. */
export const EXAMPLE_MODEL = 'hippocampus'

/** How long (ms) until a service that does not answer is asked again. */
const AGAIN_MS = 2000

/** The loaded models, once the service answers; until then it is told that it does not. */
export async function loadedModels(api: Api, status: Status): Promise<ModelSummary[]> {
  for (;;) {
    try {
      const models = await api.models()
      status.hinder('')
      return models
    } catch (fault) {
      const passes = fault instanceof Refusal && fault.isPassing
      status.hinder(passes ? sentence(fault) : '')
      if (!passes) throw fault
    }
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS))
  }
}

export function modelOptions(models: ModelSummary[], wanted: string | null = null): HTMLOptionElement[] {
  const chosen = models.some((model) => model.name === wanted) ? wanted : EXAMPLE_MODEL
  return models.map((model) => option(model.name, T.request.modelName(model), model.name === chosen))
}
