#ifndef _OPENMP
#include <thread>
#include <vector>
#endif
namespace {
// Does each of so many parts on a thread of its own.
template <class Part> void on_threads(int threads, const Part& part) {
  if (threads == 1) return part(0);
#ifdef _OPENMP
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int k = 0; k < threads; k++) part(k);
#else
  std::vector<std::thread> others;
  for (int k = 1; k < threads; k++) others.emplace_back(part, k);
  part(0);
  for (std::thread& other : others) other.join();
#endif
}
}  // namespace
