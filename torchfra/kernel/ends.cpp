#ifdef _WIN32
__declspec(dllexport)
#endif
// Filters whole tracks: the state before the first step comes from a prior, and what the last step has left open is settled.
// Returns whether what ends each track is finite.
// ``ports`` are those of the steps' own kernel, ``run``, then the prior and the last entries of what is settled late; states lie
// in ``room``, so many bytes from its start as their ports say.
extern "C" int whole(
    void (*run)(int64_t, int64_t, int, const Port*, const Port*), int64_t tracks, int64_t steps, int threads, Port* ports,
    char* room, int64_t begun) {
  constexpr int states[] = {STATES}, settled[] = {SETTLED}, sizes[] = {SIZES}, looks[] = {LOOKS};
  for (int port : states) ports[port].data = room + reinterpret_cast<int64_t>(ports[port].data);
  for (int i = 0; settled[i] >= 0; i++) {
    const Port& late = ports[settled[i]];
    ports[LAST + i].data = late.data + steps * late.time * sizes[i];
  }
  const auto over = [&](int64_t count, int64_t size, auto block) {
    for (int64_t first = 0; first < count; first += size) block(Block{first, count - first < size ? count - first : size, 0});
  };
  over(begun, W * begin::PACKS, [&](const Block& at) { begin::block(ports, ports, 1, at); });
  run(tracks, steps, threads, ports, ports + AFTER);
  over(tracks, W * finish::PACKS, [&](const Block& at) { finish::block(ports, ports, 1, at); });
  // Not finite at a step is not finite in the next one's score: all scores, which come first, and the last belief say it all.
  V sum = all(0);
  Scalar rest = 0;
  for (int port : looks) {
    const Port& p = ports[port / 2];
    const int64_t end = (steps + port % 2) * p.time, first = port == looks[0] ? port % 2 * p.time : end - p.time;
    const Scalar* x = reinterpret_cast<const Scalar*>(p.data);
    int64_t i = first;
    for (; i + W <= end; i += W) {
      V v;
      __builtin_memcpy(&v, x + i, sizeof v);
      sum += v;
    }
    for (; i < end; i++) rest += x[i];
  }
  Scalar lanes[W];
  __builtin_memcpy(lanes, &sum, sizeof lanes);
  for (Scalar x : lanes) rest += x;
  return rest - rest == 0;
}
