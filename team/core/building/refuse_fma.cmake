# Fails where FILE holds a fused multiply-add: its bits are not those of a product and a sum.
execute_process(COMMAND ${OBJDUMP} -d --no-show-raw-insn ${FILE}
  OUTPUT_VARIABLE code COMMAND_ERROR_IS_FATAL ANY)
string(REGEX MATCH "[ \t](vfn?m(add|sub)[a-z0-9]*|fn?m(add|sub)|fml[as])[ \t][^\n]*" fused "${code}")
if(fused)
  file(REMOVE ${FILE})
  message(FATAL_ERROR "${FILE} holds a fused multiply-add: ${fused}")
endif()
