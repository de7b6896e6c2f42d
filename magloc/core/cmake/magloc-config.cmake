# find_package(magloc) makes magloc::core: the headers of magloc and adcs, for C++17.
if(NOT TARGET magloc::core)
  add_library(magloc::core INTERFACE IMPORTED)
  set_target_properties(
    magloc::core PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${CMAKE_CURRENT_LIST_DIR}/../include"
                            INTERFACE_COMPILE_FEATURES cxx_std_17)
  if(NOT MSVC)
    # A square root is then one instruction.
    set_target_properties(magloc::core PROPERTIES INTERFACE_COMPILE_OPTIONS -fno-math-errno)
  endif()
endif()
