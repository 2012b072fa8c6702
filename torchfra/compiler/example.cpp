// Filters tracks, from standard input to standard output, in numbers and white space.
//
// In, for each track: how many steps it has; mean and root of the prior; and for each step LISTED.
// Out, for each step: mean and root of the belief (row by row), nis, log_likelihood.
#include "NAME.hpp"

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <vector>

using namespace NAME;

static bool is_read(double& x) { return std::scanf("%lf", &x) == 1; }
static void read(Scalar& x) {
  double value = 0;
  if (!is_read(value)) {
    std::fprintf(stderr, "expected a number, as the comment in front of example.cpp says; the input ends or has text\n");
    std::exit(1);
  }
  x = static_cast<Scalar>(value);
}
static void write(Scalar x) { std::printf("%.17g ", static_cast<double>(x)); }

int main() {
  Scalar mean[sizeof(Output::mean) / sizeof(Scalar)], root[sizeof(Output::scale_tril) / sizeof(Scalar)];
  double seconds = 0, count = 0, steps = 0;
  while (is_read(steps)) {
    if (!(steps >= 0 && steps < 1e9)) {
      std::fprintf(stderr, "expected how many steps a track has, received %g\n", steps);
      return 1;
    }
    for (Scalar& x : mean) read(x);
    for (Scalar& x : root) read(x);
    std::vector<Input> inputs(static_cast<std::size_t>(steps));
    for (Input& input : inputs) {
      // INPUTS
    }
    std::vector<Output> outputs(inputs.size());
    State state = init(mean, root);
    const auto start = std::chrono::steady_clock::now();
    for (std::size_t k = 0; k < inputs.size(); k++) outputs[k] = step(state, inputs[k]);
    seconds += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    count += static_cast<double>(inputs.size());
    for (const Output& output : outputs) {
      for (const Scalar& x : output.mean) write(x);
      for (const Scalar& x : output.scale_tril) write(x);
      write(output.nis);
      write(output.log_likelihood);
      std::printf("\n");
    }
  }
  if (!std::feof(stdin) || count == 0) {
    std::fprintf(stderr, "expected tracks of numbers on standard input, as the comment in front of example.cpp says\n");
    return 1;
  }
  std::fprintf(stderr, "%.0f steps, %.3f us each\n", count, 1e6 * seconds / count);
}
