/** Request of the user that the page cannot follow; the message says what to do. */
export class InputError extends Error {}
