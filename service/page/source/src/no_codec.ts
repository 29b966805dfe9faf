/** Stands where the viewer would load a codec of chunked image archives. */
export default class NoCodec {}
