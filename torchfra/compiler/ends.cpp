// THREADS
#include <atomic>
#ifdef _WIN32
__declspec(dllexport)
#endif
// Filters whole tracks: the state before the first step comes from a prior, and what the last step has left open is settled.
// Returns whether what ends each track is finite.
// ``like`` are the ports of the steps' own kernel, ``run``, then the prior, the last entries of what is settled late and whole
// numbers that are the same for all tracks.  Addresses come in ``places``, but those of states: they lie in ``room``, so many
// bytes from its start as their ports say.
extern "C" int whole(
    void (*run)(int64_t, int64_t, int, const Port*, const Port*), int64_t tracks, int64_t steps, int threads, const Port* like,
    char* const* places, char* room, int64_t begun) {
  constexpr int states[] = {STATES}, given[] = {GIVEN}, settled[] = {SETTLED}, sizes[] = {SIZES}, looks[] = {LOOKS};
  constexpr int64_t entries[] = {NUMBERS}, each[] = {EACH};
  Port ports[PORTS];
  for (int i = 0; i < PORTS; i++) ports[i] = like[i];
  for (int port : given) ports[port].data = *places++;
  for (int port : states) ports[port].data = room + reinterpret_cast<int64_t>(ports[port].data);
  int last = LAST;
  for (int i = 0; settled[i] >= 0; i++) {
    const Port& late = ports[settled[i]];
    ports[last++].data = late.data + steps * late.time * sizes[i];
  }
  for (int i = 0; last + i < PORTS; i++)
    for (int64_t track = 0; track < tracks; track++) reinterpret_cast<int64_t*>(ports[last + i].data)[track] = each[i];
  // What a thread does with its share of the tracks, in blocks of so many.
  const auto over = [&](int64_t count, int64_t size, int64_t thread, auto block) {
    const int64_t packs = (count + W - 1) / W, end = packs * (thread + 1) / threads * W, last = end < count ? end : count;
    for (int64_t first = packs * thread / threads * W; first < last; first += size)
      block(Block{first, last - first < size ? last - first : size, 0});
  };
  on_threads(threads, [&](int64_t thread) {
    over(begun, W * begin::PACKS, thread, [&](const Block& at) { begin::block(ports, ports, 1, at); });
  });
  run(tracks, steps, threads, ports, ports + AFTER);
  // Not finite at a step is not finite in the next one's score: all scores, which come first, and the last belief say it all.
  std::atomic<bool> sound{true};
  on_threads(threads, [&](int64_t thread) {
    V sum = all(0);
    Scalar rest = 0;
    over(tracks, W * finish::PACKS, thread, [&](const Block& at) {
      finish::block(ports, ports, 1, at);
      for (int k = 0; k < static_cast<int>(sizeof looks / sizeof *looks); k++) {
        const Port& p = ports[looks[k] / 2];
        for (int64_t step = k == 0 ? 0 : steps - 1; step < steps; step++)
          for (int64_t entry = 0; entry < entries[k]; entry++) {
            const Scalar* x = reinterpret_cast<const Scalar*>(p.data) + (step + looks[k] % 2) * p.time + entry * p.entry + at.first;
            int64_t i = 0;
            for (; i + W <= at.lanes; i += W) {
              V v;
              __builtin_memcpy(&v, x + i, sizeof v);
              sum += v;
            }
            for (; i < at.lanes; i++) rest += x[i];
          }
      }
    });
    Scalar lanes[W];
    __builtin_memcpy(lanes, &sum, sizeof lanes);
    for (Scalar x : lanes) rest += x;
    if (rest - rest != 0) sound = false;
  });
  return sound;
}
