import{a,b}from"./chunk-2ETW2KNK.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
