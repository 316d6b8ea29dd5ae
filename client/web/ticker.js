// A worker that answers a number of milliseconds that long after it came. Timers of pages that are out of sight are slowed to one
// a second, a worker's are not: whoever publishes from one tab while watching another goes on.

addEventListener("message", ({ data: wait }) => setTimeout(() => postMessage(null), wait));
