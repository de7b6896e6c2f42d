// The public kernels: each calls its version for the instruction set in use.
#include "magloc/kernel.hpp"

#define DECLARE(name, problem_type, isa) \
  extern "C" int64_t magloc_##name##_##isa(const magloc_##problem_type *, int64_t, int64_t, double *);
#define DECLARE_ALL(name, problem_type) \
  DECLARE(name, problem_type, baseline) \
  DECLARE(name, problem_type, avx2)     \
  DECLARE(name, problem_type, avx512)
MAGLOC_KERNELS(DECLARE_ALL)

namespace {
enum InstructionSet { baseline, avx2, avx512, unknown };
const char *const names[] = {"baseline", "avx2", "avx512"};

#if defined(MAGLOC_SET_avx2) || defined(MAGLOC_SET_avx512)
void cpuid(uint32_t leaf, uint32_t (&registers)[4]) {
  __asm__ volatile("cpuid"
                   : "=a"(registers[0]), "=b"(registers[1]), "=c"(registers[2]), "=d"(registers[3])
                   : "a"(leaf), "c"(0));
}

// Which sets the processor has and the operating system saves; __builtin_cpu_supports does not work with Zig.
InstructionSet best_of_machine() {
  uint32_t r[4];
  cpuid(0, r);
  if (r[0] < 7) return baseline;
  cpuid(1, r);
  const uint32_t fma = 1u << 12, movbe = 1u << 22, osxsave = 1u << 27, avx = 1u << 28, f16c = 1u << 29;
  const uint32_t needed = fma | movbe | osxsave | avx | f16c;
  if ((r[2] & needed) != needed) return baseline;
  uint32_t low, high;
  __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  if ((low & 0x6) != 0x6) return baseline;
  cpuid(0x80000001, r);
  const bool lzcnt = r[2] & (1u << 5);
  cpuid(7, r);
  const uint32_t bmi1 = 1u << 3, has_avx2 = 1u << 5, bmi2 = 1u << 8, v3 = bmi1 | has_avx2 | bmi2;
  if (!lzcnt || (r[1] & v3) != v3) return baseline;
  const uint32_t v4 = 1u << 16 | 1u << 17 | 1u << 28 | 1u << 30 | 1u << 31;  // AVX-512 F, DQ, CD, BW, VL
  return (r[1] & v4) == v4 && (low & 0xe6) == 0xe6 ? avx512 : avx2;
}
#else
InstructionSet best_of_machine() { return baseline; }
#endif

bool is_built(InstructionSet set) {
  switch (set) {
    case baseline:
      return true;
#ifdef MAGLOC_SET_avx2
    case avx2:
      return true;
#endif
#ifdef MAGLOC_SET_avx512
    case avx512:
      return true;
#endif
    default:
      return false;
  }
}

// Found at the first call. Threads that are first together find the same.
volatile int in_use = unknown;

int instruction_set() {
  int set = in_use;
  if (set == unknown) {
    set = best_of_machine();
    while (!is_built((InstructionSet)set)) --set;
    in_use = set;
  }
  return set;
}

bool equal(const char *a, const char *b) {
  while (*a && *a == *b) ++a, ++b;
  return *a == *b;
}
}  // namespace

const char *magloc_instruction_set(void) { return names[instruction_set()]; }

int magloc_use_instruction_set(const char *name) {
  for (int set = baseline; set <= best_of_machine(); ++set)
    if (is_built((InstructionSet)set) && equal(name, names[set])) {
      in_use = set;
      return 0;
    }
  return 1;
}

#ifdef MAGLOC_SET_avx2
#define IF_AVX2(call) \
  if (set == avx2) return call;
#else
#define IF_AVX2(call)
#endif
#ifdef MAGLOC_SET_avx512
#define IF_AVX512(call) \
  if (set == avx512) return call;
#else
#define IF_AVX512(call)
#endif
#define DISPATCH(name, problem_type)                                                                     \
  int64_t magloc_##name(const magloc_##problem_type *p, int64_t begin, int64_t end, double *workspace) { \
    [[maybe_unused]] const int set = instruction_set();                                                  \
    IF_AVX512(magloc_##name##_avx512(p, begin, end, workspace))                                          \
    IF_AVX2(magloc_##name##_avx2(p, begin, end, workspace))                                              \
    return magloc_##name##_baseline(p, begin, end, workspace);                                           \
  }
MAGLOC_KERNELS(DISPATCH)
