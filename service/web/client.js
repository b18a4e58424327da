import{a,b}from"./chunk-PZ3BUION.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
