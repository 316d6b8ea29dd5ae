// A worker that ticks. Timers of pages that are out of sight are slowed to one a second, a worker's are not: whoever publishes from
// one tab while watching another goes on.

let timer = 0;
addEventListener("message", ({ data: interval }) => {
  clearInterval(timer);
  timer = setInterval(() => postMessage(null), interval);
});
