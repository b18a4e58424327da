/** History of changes, for undo and redo. */

const MAX_STEPS = 200;

export class History<T> {
  private states: T[];
  private index = 0;

  constructor(first: T) {
    this.states = [first];
  }

  get now(): T {
    return this.states[this.index]!;
  }

  get canUndo(): boolean {
    return this.index > 0;
  }

  get canRedo(): boolean {
    return this.index < this.states.length - 1;
  }

  /** Add a state; with `goesOn` it replaces the last one, as while dragging, unless that was undone meanwhile. */
  push(next: T, goesOn: boolean): void {
    if (next === this.now) return;
    const kept = this.index + (goesOn && !this.canRedo ? 0 : 1);
    this.states = [...this.states.slice(0, kept), next].slice(-MAX_STEPS - 1);
    this.index = this.states.length - 1;
  }

  undo(): void {
    if (this.canUndo) this.index--;
  }

  redo(): void {
    if (this.canRedo) this.index++;
  }
}
