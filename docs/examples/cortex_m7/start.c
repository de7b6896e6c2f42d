/* Start of a Cortex-M7: its floating-point unit, memory, constructors, the console of a
 * debugger, and main. */
extern unsigned __stack, __data_start, __data_end, __data_load, __bss_start__,
    __bss_end__;
extern void (*__init_array_start[])(void), (*__init_array_end[])(void);
extern int main(void);
extern void initialise_monitor_handles(void);
extern void exit(int);

void reset(void) {
  *(volatile unsigned *)0xE000ED88 |=
      0xFu << 20; /* the floating-point unit is off at first */
  __asm volatile("dsb; isb");
  unsigned *from = &__data_load;
  for (unsigned *to = &__data_start; to < &__data_end;) *to++ = *from++;
  for (unsigned *to = &__bss_start__; to < &__bss_end__;) *to++ = 0;
  initialise_monitor_handles();
  for (void (**constructor)(void) = __init_array_start; constructor < __init_array_end;)
    (*constructor++)();
  exit(main());
}
void _start(void) { reset(); }
void _init(void) {}
void _fini(void) {}
void fault(void) {
  for (;;) {
  }
}
__attribute__((section(".vectors"), used)) void *vectors[16] = {
    &__stack, reset, fault, fault, fault, fault, fault};
